"""Whole datasets through the command line: content, resuming, repeatability, faults of the user."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.imaging.exr import CHANNELS, read_exr
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate

RENDER = str(Path(sys.executable).parent / "perilune-render")
DETECT = ["dataset", "--preset", "tiny", "--kind", "detect"]
ONE_WORKER = ["--workers", "1"]
"""By default there is one for each core, and each loads Blender."""
IN_PROCESS = ["--workers", "0"]
"""Renders in the process of the test, where Blender is loaded once."""
QUICK = [
    "--set",
    "dataset.camera.width_px=32",
    "--set",
    "dataset.camera.height_px=32",
    "--set",
    "dataset.render.exr=false",
    "--set",
    "dataset.terrain.spacing_px=2.0",
    "--set",
    "dataset.detect.n_frames=12",
]


WITHOUT_BLENDER = ["--set", "dataset.render.engine=heightfield"]


def run(*arguments):
    """In this process, where Blender is loaded once."""
    return in_process.call(main, *arguments)


def children_of(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def eventually(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not (fulfilled := condition()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return fulfilled


def hashes(dataset):
    return dataset.table("frames", ["png_sha256"]).to_pandas()["png_sha256"].tolist()


@pytest.fixture(params=["quick", pytest.param("tiny", marks=pytest.mark.slow)])
def rendered(request):
    """Datasets rendered by either engine."""
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("kind", ["detect", "nav"])
def test_a_rendered_dataset_has_no_fault(rendered, kind):
    assert validate(open_dataset(rendered / kind)) == []


def test_every_rendered_frame_counts_the_craters_that_are_too_large_for_a_label(quick):
    counts = open_dataset(quick / "detect").table("frames", ["n_craters_above_max_radius"]).to_pydict()
    assert counts["n_craters_above_max_radius"] == [0] * 24


def test_frames_are_grey_lit_and_different(rendered):
    dataset = open_dataset(rendered / "detect")
    images = [
        cv2.imread(str(dataset.file(path)), cv2.IMREAD_UNCHANGED)
        for path in dataset.table("frames").to_pandas()["png_path"]
    ]
    assert all(image.shape == (128, 128) and image.dtype == np.uint8 for image in images)
    assert all(40 < image.mean() < 210 and image.std() > 5 for image in images)
    assert len({image.tobytes() for image in images}) == len(images) == 24


def test_exr_holds_what_it_should(rendered):
    dataset = open_dataset(rendered / "detect")
    frame = dataset.table("frames").to_pandas().iloc[3]
    exr = read_exr(dataset.file(frame.exr_path))
    assert set(exr) == set(CHANNELS) and all(c.dtype == np.float32 and c.shape == (128, 128) for c in exr.values())
    assert abs(np.median(exr["Z"]) / frame.position_m[2] - 1) < 0.1
    normals = np.stack([exr["N.X"], exr["N.Y"], exr["N.Z"]], axis=-1)
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3) and np.median(normals[..., 2]) > 0.9
    craters = dataset.table("craters", scene_id=frame.scene_id).num_rows
    assert exr["crater"].min() == -1 and exr["crater"].max() < craters and (exr["crater"] >= 0).any()
    assert 0.005 < exr["R"].mean() < 0.2


def test_the_camera_looks_down_at_the_site(quick):
    dataset = open_dataset(quick / "nav")
    frames = dataset.table("frames").to_pandas()
    last = frames[frames["frame_index"] == 8].iloc[0]
    axis = matrix_from_quaternion(last.rotation_wxyz)[2]
    assert axis[2] < -0.999 and abs(last.position_m[2] - 200) < 40 and np.hypot(*last.position_m[:2]) < 40


@pytest.mark.slow
def test_stopped_and_resumed_is_the_same_dataset(tmp_path):
    command = [RENDER, "dataset", "--preset", "tiny", "--kind", "detect", *QUICK]
    assert run(*command[1:], *IN_PROCESS, "--out", tmp_path / "whole").returncode == 0
    process = subprocess.Popen(
        [*command, *ONE_WORKER, "--out", str(tmp_path / "cut")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    commits = tmp_path / "cut/detect/work/index"
    deadline = time.monotonic() + 60
    while not any(commits.glob("[!.]*")) and time.monotonic() < deadline:
        time.sleep(0.005)
    workers = children_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert workers and eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    cut = open_dataset(tmp_path / "cut/detect")
    done = [path.stem.replace(".", "/") for path in commits.glob("[!.]*")]
    assert not cut.info.complete and 0 < len(done) < 3
    frames = [path for name in done for path in (tmp_path / "cut/detect/frames" / name).glob("*.png")]
    before = {path: path.stat().st_mtime_ns for path in frames}
    assert run(*command[1:], *IN_PROCESS, "--out", tmp_path / "cut").returncode == 0
    assert before and all(p.stat().st_mtime_ns == t for p, t in before.items())
    whole, again = open_dataset(tmp_path / "whole/detect"), open_dataset(tmp_path / "cut/detect")
    assert hashes(whole) == hashes(again) and validate(again) == []
    for table in ("scenes", "craters", "boulders", "trajectories", "labels"):
        assert whole.table(table).equals(again.table(table))


@pytest.mark.slow
def test_ctrl_c_is_answered_in_one_line(tmp_path):
    command = [RENDER, *DETECT, *QUICK, *ONE_WORKER, "--out", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    deadline = time.monotonic() + 60
    while not any(tmp_path.rglob("*.png")) and time.monotonic() < deadline:
        time.sleep(0.01)
    workers, asked = children_of(process.pid), time.monotonic()
    process.send_signal(signal.SIGINT)
    stderr = process.communicate(timeout=60)[1]
    assert time.monotonic() - asked < 3 and workers and not any(Path(f"/proc/{pid}").exists() for pid in workers)
    assert process.returncode == 130 and "Traceback" not in stderr and "again to resume" in stderr


def test_a_finished_dataset_is_reused_and_other_settings_are_refused(tmp_path):
    options = [*DETECT, *QUICK, *WITHOUT_BLENDER]
    assert run(*options, *IN_PROCESS, "--out", tmp_path).returncode == 0
    stamp = (tmp_path / "detect/dataset.json").stat().st_mtime_ns
    assert run(*options, *IN_PROCESS, "--out", tmp_path).returncode == 0
    assert (tmp_path / "detect/dataset.json").stat().st_mtime_ns == stamp
    other = run(*options, "--set", "dataset.seed=5", "--out", tmp_path)
    assert other.returncode == 2 and "seed" in other.stderr and len(other.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--set", "dataset.camra.width_px=3"], ["dataset.camra", "camera (nearest known)"]),
        (["--set", "dataset.camera.width_px=-3"], ["dataset.camera.width_px", "-3"]),
        (["--config", "nowhere.yaml"], ["nowhere.yaml", "no such file"]),
        (["--preset", "tinny"], ["tinny", "tiny (nearest known)"]),
        (["--dem", "nowhere.tif"], ["nowhere.tif", "GeoTIFF"]),
        (["--catalogue", "craters.csv"], ["craters.csv", "--dem"]),
        (["--set", "dataset.camera.width_px=2000"], ["dataset.terrain.spacing_px", "vertices"]),
    ],
)
def test_faults_of_the_user_end_with_one_line_and_code_2(tmp_path, arguments, parts):
    result = run("dataset", "--preset", "tiny", "--kind", "detect", *IN_PROCESS, *arguments, "--out", tmp_path / "out")
    assert result.returncode == 2 and "Traceback" not in result.stderr
    lines = [line for line in result.stderr.strip().splitlines() if line.startswith("error")]
    assert len(lines) == 1 and all(part in lines[0] for part in parts)
    assert not list(tmp_path.iterdir())


def test_a_folder_with_other_content_is_left_alone(tmp_path):
    (tmp_path / "detect").mkdir()
    (tmp_path / "detect/thesis.txt").write_text("mine")
    result = run("dataset", "--preset", "tiny", "--kind", "detect", "--out", tmp_path)
    assert result.returncode == 2 and "other content" in result.stderr
    assert [p.name for p in (tmp_path / "detect").iterdir()] == ["thesis.txt"]


@pytest.mark.slow
def test_a_full_disk_leaves_what_was_finished(tmp_path):
    """A file size limit stands in for a full disk: the kernel refuses to write on, in mid-file."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    command = [RENDER, *DETECT, *QUICK, *ONE_WORKER, "--out", str(tmp_path)]
    # Coverage could not write its own file either.
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    result = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit, env=plain)
    assert result.returncode == 2 and "Traceback" not in result.stderr and "stay valid" in result.stderr
    dataset = open_dataset(tmp_path / "detect")
    for fault in validate(dataset):
        assert "readable part" not in fault.expected, fault
    assert not [p for p in tmp_path.rglob("*") if ".part" in p.name]
    assert run(*DETECT, *QUICK, *IN_PROCESS, "--out", tmp_path).returncode == 0
    assert validate(open_dataset(tmp_path / "detect")) == []


def test_preview_and_export(tmp_path):
    coarse = ("--preset", "tiny", "--set", "dataset.terrain.spacing_px=2.0")
    assert run("preview", *coarse, "--out", tmp_path / "p.png").returncode == 0
    picture = cv2.imread(str(tmp_path / "p.png"))
    assert picture.shape == (520, 1040, 3) and picture.std() > 10
    assert run("ground", *coarse, "--step", 3, "--out", tmp_path / "m.ply").returncode == 0
    import trimesh

    mesh = trimesh.load(tmp_path / "m.ply")
    assert len(mesh.faces) > 10_000 and mesh.extents[0] > 2000
    assert run("ground", *coarse, "--pixel-m", 10, "--out", tmp_path / "m.tif").returncode == 0
    assert (tmp_path / "m.tif").stat().st_size > 10_000
    bad = run("ground", "--preset", "tiny", "--out", tmp_path / "m.xyz")
    assert bad.returncode == 2 and ".glb" in bad.stderr


def test_a_damaged_dataset_is_refused(quick_detect):
    info = json.loads((quick_detect / "dataset.json").read_text())
    (quick_detect / "dataset.json").write_text(json.dumps({**info, "schema_version": "7"}))
    with pytest.raises(UserError, match="schema_version"):
        open_dataset(quick_detect)
    shutil.rmtree(quick_detect)
    with pytest.raises(UserError, match=r"dataset\.json"):
        open_dataset(quick_detect)
