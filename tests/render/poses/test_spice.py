"""Poses and Sun from SPICE kernels, against the truth by hand, and frames rendered from them."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.helpers import in_process
from tests.render.poses.spice_kernels import (
    CAMERA_FROM_FIXED_WXYZ,
    HEIGHT_M,
    LATITUDE,
    LONGITUDE,
    START_M,
    T0,
    VELOCITY_MPS,
    site_axes,
    sun_at_km,
    sun_truth_deg,
    write_kernels,
)

from perilune_render.cli.main import main
from perilune_render.flight.sub_poses import moved
from perilune_render.poses import spice as spice_module
from perilune_render.poses.axes import camera_axes
from perilune_render.poses.file import read_poses
from perilune_render.poses.spice import SpiceSource
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate

spiceypy = pytest.importorskip("spiceypy")

SITE = {"latitude_deg": LATITUDE, "longitude_deg": LONGITUDE}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with kernels and a scene at their site."""
    folder = tmp_path_factory.mktemp("kernels")
    write_kernels(folder)
    scene = {"terrain": {**SITE, "spacing_px": 3.0}, "render": {"samples": 1, "engine": "heightfield"}}
    (folder / "scene.yaml").write_text(yaml.safe_dump({"dataset": {"name": "spice", **scene}}))
    return folder


def utc(folder, seconds):
    spiceypy.furnsh(str(folder / "a.tls"))
    try:
        return spiceypy.et2utc(T0 + seconds, "ISOC", 12)
    finally:
        spiceypy.kclear()


def spice(folder, out, *more, frames=3, last=10.0, **options):
    if "start" not in options:
        options = {"start": utc(folder, 0.0), **options}
    if "end" not in options:
        options = {"end": utc(folder, last), **options}
    given = {
        "kernels": folder / "all.tm",
        "spacecraft": "TEST_LANDER",
        "camera-frame": "TEST_CAM",
        "scene": folder / "scene.yaml",
        "site-height-m": HEIGHT_M,
        "frames": frames,
        **options,
    }
    arguments = [text for name, value in given.items() for text in (f"--{name}", value) if value is not None]
    return in_process.call(main, "spice", "--preset", "tiny", *arguments, "--out", out, *more)


def test_poses_and_suns_are_those_by_hand(folder, tmp_path):
    done = spice(folder, tmp_path / "poses.csv")
    assert done.returncode == 0, done.stderr
    assert "3 poses" in done.stdout and "relative to IAU_MOON" in " ".join(done.stdout.split())
    poses = read_poses(tmp_path / "poses.csv", LATITUDE, LONGITUDE)
    time = np.array([0.0, 5.0, 10.0])
    assert np.allclose(poses.time_s, time, rtol=0, atol=1e-6)
    assert np.abs(poses.position_m - (START_M + VELOCITY_MPS * time[:, None])).max() < 1e-6
    assert np.abs(poses.velocity_mps - VELOCITY_MPS).max() < 1e-6
    truth = matrix_from_quaternion(CAMERA_FROM_FIXED_WXYZ) @ site_axes().T
    assert np.abs(matrix_from_quaternion(poses.rotation_wxyz) - truth).max() < 1e-9
    suns = [sun_truth_deg(T0 + t, sun_at_km()) for t in time]
    assert np.abs(poses.sun_deg - suns).max() < 1e-4
    # Without light time and aberration the Sun would be where the kernels were made for.
    assert np.abs(poses.sun_deg[0] - [130, 20]).max() > 1e-3


@pytest.mark.parametrize(("axes", "turned"), [("x,y,z", np.eye(3)), ("-y,x,z", [[0, -1, 0], [1, 0, 0], [0, 0, 1]])])
def test_the_turn_of_the_camera_is_that_relative_to_the_ground_in_its_own_axes(tmp_path, axes, turned):
    rate = np.array([0.02, -0.03, 0.05])
    write_kernels(tmp_path, turn_radps=rate)
    scene = {"terrain": {**SITE, "spacing_px": 3.0}}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"dataset": {"name": "spice", **scene}}))
    done = spice(tmp_path, tmp_path / "poses.csv", frames=6, last=5.0, **{"camera-axes": axes})
    assert done.returncode == 0, done.stderr
    poses = read_poses(tmp_path / "poses.csv", LATITUDE, LONGITUDE)
    assert np.allclose(poses.angular_velocity_radps, turned @ rate, rtol=0, atol=1e-7)
    # The rate carries each attitude to the next.
    start = np.zeros(3), matrix_from_quaternion(poses.rotation_wxyz[0])
    later = moved(start, np.zeros(3), poses.angular_velocity_radps[0], 1.0)[1]
    assert np.allclose(later, matrix_from_quaternion(poses.rotation_wxyz[1]), rtol=0, atol=1e-6)


def test_kernels_without_angular_velocities_give_a_file_without_them(folder, tmp_path):
    assert spice(folder, tmp_path / "poses.csv").returncode == 0
    assert read_poses(tmp_path / "poses.csv", LATITUDE, LONGITUDE).angular_velocity_radps is None
    assert "# no angular velocities" in (tmp_path / "poses.csv").read_text()


def test_steps_axes_and_frames_of_fixed_orientation(folder, tmp_path):
    more = {"frames": None, "step-s": 2.0, "camera-frame": "TEST_DOWN", "fixed-frame": "IAU_MOON", "spacecraft": "-99"}
    done = spice(folder, tmp_path / "poses.csv", last=9.0, **more)
    assert done.returncode == 0, done.stderr
    poses = read_poses(tmp_path / "poses.csv", LATITUDE, LONGITUDE)
    assert np.allclose(poses.time_s, [0, 2, 4, 6, 8])
    assert np.allclose(matrix_from_quaternion(poses.rotation_wxyz), np.diag([1, -1, -1]), atol=1e-9)
    assert spice(folder, tmp_path / "b.csv", **{**more, "camera-axes": "-y,x,z"}).returncode == 0
    turned = read_poses(tmp_path / "b.csv", LATITUDE, LONGITUDE)
    assert np.allclose(matrix_from_quaternion(turned.rotation_wxyz[0]), [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-9)
    for wrong in ("x,y,-z", "x,y", "x,x,z", "a,b,c", ""):
        with pytest.raises(UserError, match="three axes of a right-handed frame"):
            camera_axes(wrong, "--camera-axes")


def test_frames_are_rendered_from_kernels(folder, tmp_path):
    assert spice(folder, tmp_path / "poses.csv", frames=2, **{"camera-frame": "TEST_DOWN"}).returncode == 0
    (tmp_path / "camera.yaml").write_text("width_px: 32\nheight_px: 32\nhorizontal_fov_deg: 40\n")
    given = ["--poses", tmp_path / "poses.csv", "--camera", tmp_path / "camera.yaml", "--preset", "tiny"]
    scene = ["--scene", folder / "scene.yaml"]
    done = in_process.call(main, "frames", *given, *scene, "--workers", 0, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "out")
    assert validate(made) == []
    frames = made.table("frames").sort_by("frame_id").to_pydict()
    assert np.allclose(frames["position_m"], [START_M, START_M + 10 * VELOCITY_MPS], atol=1e-6)
    assert np.allclose(frames["velocity_mps"], [VELOCITY_MPS] * 2, atol=1e-6)
    assert made.table("scenes")["sun_elevation_deg"][0].as_py() == pytest.approx(20.0, abs=0.01)
    other = in_process.call(main, "frames", *given, "--workers", 0, "--out", tmp_path / "other", "--set", OTHER_SITE)
    assert other.returncode == 2 and "site: got -45.5 177.6, expected -45.400000" in " ".join(other.stderr.split())
    assert not (tmp_path / "other").exists()


OTHER_SITE = "dataset.terrain.latitude_deg=-45.4"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kernels": "none.tm"}, "none.tm: kernel: got no such file"),
        ({"spacecraft": "APOLLO"}, "--spacecraft: got APOLLO"),
        ({"spacecraft": "-77"}, "SPICE(SPKINSUFFDATA)"),
        ({"camera-frame": "OTHER_CAM"}, "--camera-frame: got OTHER_CAM"),
        ({"fixed-frame": "J2000"}, "--fixed-frame: got J2000"),
        ({"fixed-frame": "MOON_XY"}, "--fixed-frame: got MOON_XY"),
        ({"last": 60.0}, "SPICE(SPKINSUFFDATA)"),
        ({"start": "yesterday"}, "SPICE: --start: "),
        ({"last": -5.0}, "expected a time after --start"),
        ({"step-s": 1.0}, "--frames and --step-s: got both or neither"),
        ({"frames": 1000000}, "expected 1 to 100000"),
    ],
)
def test_errors_are_one_line_and_leave_no_file(folder, tmp_path, options, message):
    done = spice(folder, tmp_path / "poses.csv", **options)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and line.startswith("error: ") and message in line
    assert not list(tmp_path.iterdir())


def test_missing_attitude_and_time_kernels_are_named(folder, tmp_path):
    loaded = [folder / name for name in ("a.tls", "a.tpc", "a.tf", "a.bsp")]
    more = [text for path in loaded[1:] for text in ("--kernels", path)]
    done = spice(folder, tmp_path / "poses.csv", *more, kernels=loaded[0])
    assert done.returncode == 2 and "SPICE(NOFRAMECONNECT)" in done.stderr and "CK" in done.stderr
    done = spice(folder, tmp_path / "poses.csv", kernels=folder / "a.bsp")
    assert done.returncode == 2 and "expected a kernel of leap seconds (LSK)" in done.stderr


def meta_kernel(path, *names, more=""):
    listed = ", ".join(f"'{name}'" for name in names)
    path.write_text(f"KPL/MK\n\\begindata\n{more}KERNELS_TO_LOAD = ( {listed} )\n")
    return path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.bsp", "none.bsp: no such file"),
        ("pipe.bsp", "pipe.bsp: a pipe or a device"),
        ("/dev/zero", "/dev/zero: a pipe or a device"),
        ("linked", "linked: a pipe or a device"),
        ("", "a quoted string with no characters"),
        (".", ".: a folder"),
        ("other.tm", "KERNELS_TO_LOAD: got the meta-kernel other.tm, expected a kernel that names no others"),
        ("http://localhost/a.bsp", "http:/localhost/a.bsp: no such file"),
    ],
)
def test_every_file_of_a_meta_kernel_is_checked_before_it_is_opened(folder, tmp_path, monkeypatch, name, message):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.bsp")
    Path("linked").symlink_to("/dev/random")
    meta_kernel(Path("other.tm"), "pipe.bsp")
    path = meta_kernel(tmp_path / "all.tm", folder / "a.tls", name)
    done = spice(folder, tmp_path / "poses.csv", kernels=path)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and message in line and "all.tm" in line
    assert not (tmp_path / "poses.csv").exists()


def test_a_pipe_as_kernel_and_a_file_without_content_are_refused(folder, tmp_path):
    os.mkfifo(tmp_path / "pipe.tm")
    (tmp_path / "empty.tm").write_bytes(b"")
    for name, message in (("pipe.tm", "a pipe or a device"), ("empty.tm", "SPICE")):
        done = spice(folder, tmp_path / "poses.csv", kernels=tmp_path / name)
        assert done.returncode == 2 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_symbols_of_paths_and_continued_paths_name_the_files_that_are_loaded(folder, tmp_path, monkeypatch):
    """AB is not A with a B behind; a path goes on in the next text after a +."""
    monkeypatch.chdir(tmp_path)
    assert spice(folder, tmp_path / "plain.csv").returncode == 0
    names = [f"$AB/{name}" for name in ("a.tls", "a.tpc", "a.tf", "a.tsc", "a.bsp")]
    more = f"PATH_VALUES = ( '/none', '{folder}' )\nPATH_SYMBOLS = ( 'A', 'AB' )\n"
    path = meta_kernel(tmp_path / "all.tm", *names, "$AB/+", "a.bc", more=more)
    done = spice(folder, tmp_path / "poses.csv", kernels=path)
    assert done.returncode == 0, done.stderr
    plain, given = (read_poses(tmp_path / name, LATITUDE, LONGITUDE) for name in ("plain.csv", "poses.csv"))
    assert plain.sha256 == given.sha256
    meta_kernel(path, *names, more="PATH_VALUES = ( '/none' )\nPATH_SYMBOLS = ( 'A', 'AB' )\n")
    done = spice(folder, tmp_path / "b.csv", kernels=path)
    assert done.returncode == 2 and "1 values for 2 symbols" in done.stderr


def test_a_kernel_that_becomes_a_pipe_after_its_check_ends_at_the_limit_of_time(folder, tmp_path, monkeypatch):
    """SPICE waits for a writer of the pipe; the process is ended."""
    os.mkfifo(tmp_path / "pipe.tls")
    source = SpiceSource(
        (tmp_path / "pipe.tls",), "-99", "TEST_CAM", "x,y,z", None, "2017-01-01", "2017-01-02", 2, None
    )
    monkeypatch.setattr(spice_module, "_LOADING_LIMIT_S", 3.0)
    monkeypatch.setattr(spice_module, "_send", unchecked)
    with pytest.raises(UserError, match=r"got no result after 3 s of reading pipe.tls"):
        spice_module.read_spice(source, LATITUDE, LONGITUDE, HEIGHT_M)


def unchecked(sending, source, *site):
    """Load a kernel without a check, as after a change of the file."""
    spiceypy.furnsh(str(source.kernels[0]))


def test_a_sun_below_the_horizon_is_refused(tmp_path):
    write_kernels(tmp_path, sun_km=-sun_at_km())
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"dataset": {"terrain": SITE}}))
    done = spice(tmp_path, tmp_path / "poses.csv")
    assert done.returncode == 2 and "elevation of the Sun: got -" in done.stderr


def test_damaged_kernels_are_one_line(folder, tmp_path):
    rng = np.random.default_rng(1)
    whole = (folder / "a.bsp").read_bytes()
    others = [text for name in ("a.tls", "a.tpc", "a.tf", "a.tsc", "a.bc") for text in ("--kernels", folder / name)]
    for k in range(4):
        damaged = bytearray(whole[: len(whole) // 2] if k == 0 else whole)
        for place in rng.integers(0, len(damaged), 40):
            damaged[place] = rng.integers(256)
        (tmp_path / "damaged.bsp").write_bytes(bytes(damaged))
        done = spice(folder, tmp_path / "poses.csv", *others, kernels=tmp_path / "damaged.bsp")
        assert done.returncode in (0, 2) and len(done.stderr.strip().splitlines()) <= 1


def test_a_crash_of_the_library_is_one_line(folder, tmp_path):
    """SPICE reads past an array if the number of doubles of a summary, byte 8 of the file record, is too large."""
    damaged = bytearray((folder / "a.bc").read_bytes())
    damaged[8] = 86
    (tmp_path / "a.bc").write_bytes(bytes(damaged))
    names = [folder / name for name in ("a.tpc", "a.tf", "a.tsc", "a.bsp")] + [tmp_path / "a.bc"]
    done = spice(
        folder, tmp_path / "poses.csv", *[t for n in names for t in ("--kernels", n)], kernels=folder / "a.tls"
    )
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and line.startswith("error: SPICE: ")
    assert not (tmp_path / "poses.csv").exists()


def test_without_the_library_the_extra_is_named(folder, tmp_path, monkeypatch):
    first, last = (utc(folder, t) for t in (0.0, 1.0))
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    done = spice(folder, tmp_path / "poses.csv", start=first, end=last)
    assert done.returncode == 2 and "pip install 'perilune-render[spice]'" in done.stderr
