"""The command `frames`: an ordinary dataset from given poses."""

import shutil

import numpy as np
import pytest
import yaml
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.validation.validate import validate

DOWN = "0,1,0,0"
"""The quaternion of a camera that looks straight down."""
NAMES = "time_s,x_m,y_m,z_m,qw,qx,qy,qz"
SCENE = {
    "dataset": {
        "name": "given",
        "seed": 5,
        "terrain": {"spacing_px": 1.0},
        "render": {"samples": 1, "engine": "heightfield"},
        "scene": {"sun_azimuth_deg": 100, "sun_elevation_deg": 25},
    }
}


def frames(folder, *more, out="out", poses="poses.csv", scene="scene.yaml", camera="camera.yaml"):
    files = ["--poses", folder / poses, "--scene", folder / scene, "--camera", folder / camera]
    return in_process.call(main, "frames", *files, "--out", folder / out, "--preset", "tiny", "--workers", 0, *more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Poses, scene and camera of a user, and the frames rendered from them."""
    folder = tmp_path_factory.mktemp("given")
    lines = [f"{t},{10 * t},-40,{300 - 30 * t},{DOWN}" for t in range(3)]
    (folder / "poses.csv").write_text("\n".join(["# frame: O_L", NAMES, *lines, ""]))
    (folder / "scene.yaml").write_text(yaml.safe_dump(SCENE))
    (folder / "camera.yaml").write_text("width_px: 64\nheight_px: 48\nhorizontal_fov_deg: 40\n")
    done = frames(folder)
    assert done.returncode == 0, done.stderr
    return folder


def columns(dataset, name):
    return dataset.table("frames").sort_by("frame_id")[name].to_pylist()


def test_it_is_a_valid_dataset_of_the_given_poses(folder):
    made = open_dataset(folder / "out")
    assert validate(made) == []
    assert columns(made, "position_m") == [[0, -40, 300], [10, -40, 270], [20, -40, 240]]
    assert columns(made, "rotation_wxyz") == [[0, 1, 0, 0]] * 3
    assert np.allclose(columns(made, "sun_direction"), sun_direction(100, 25), rtol=0, atol=1e-12)
    assert made.info.camera.intrinsics().width_px == 64
    assert made.info.counts.labels > 10


def test_the_manifest_alone_gives_the_same_bytes(folder):
    done = in_process.call(main, "regenerate", "--manifest", folder / "out", "--verify", "--all")
    assert done.returncode == 0
    assert "3 frames: 3 identical" in done.stdout


def test_a_tum_file_of_the_same_poses_gives_the_same_frames(folder):
    lines = [f"{t} {10 * t} -40 {300 - 30 * t} 1 0 0 0" for t in range(3)]
    (folder / "poses.tum").write_text("\n".join(["# frame: O_L", *lines, ""]))
    done = frames(folder, out="tum", poses="poses.tum")
    assert done.returncode == 0, done.stderr
    first, second = (columns(open_dataset(folder / name), "png_sha256") for name in ("out", "tum"))
    assert first == second


def test_it_resumes_and_refuses_other_poses(folder):
    again = frames(folder)
    assert again.returncode == 0, again.stderr
    text = (folder / "poses.csv").read_text()
    (folder / "other.csv").write_text(text.replace("-40", "-41"))
    other = frames(folder, poses="other.csv")
    assert other.returncode == 2
    assert "poses_sha256" in other.stderr.replace("\n", "")


def test_every_sun_of_the_poses_is_a_scene_over_the_same_ground(folder):
    names = f"{NAMES},sun_azimuth_deg,sun_elevation_deg"
    suns = ((0, 20), (0.01, 20.01), (90, 40))
    lines = [f"{t},0,0,{300 + t},{DOWN},{a},{e}" for t, (a, e) in enumerate(suns)]
    (folder / "suns.csv").write_text("\n".join(["# frame: O_L", names, *lines, ""]))
    done = frames(folder, out="suns", poses="suns.csv")
    assert done.returncode == 0, done.stderr
    made = open_dataset(folder / "suns")
    assert validate(made) == []
    scenes = made.table("scenes").sort_by("scene_id")
    assert scenes["sun_azimuth_deg"].to_pylist() == [0, 90]
    assert len(set(scenes["content_sha256"].to_pylist())) == 1
    assert columns(made, "frame_id") == [
        "scene-0000/trajectory-0000/000000",
        "scene-0000/trajectory-0000/000001",
        "scene-0001/trajectory-0000/000002",
    ]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"0,0,0,-5,{DOWN}", "line 3: pose at 0 s: got z -5.0 m"),
        ("0,0,0,300,1,0,0,0", "a view with the horizon"),
        ("0,0,0,300,0.7071068,0.7071068,0,0", "a view with the horizon"),
    ],
)
def test_a_pose_that_fits_no_ground_is_refused_and_leaves_no_folder(folder, line, message):
    (folder / "bad.csv").write_text("\n".join(["# frame: O_L", NAMES, line, ""]))
    done = frames(folder, out="none", poses="bad.csv")
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())
    assert not (folder / "none").exists()


def test_a_pose_off_the_stated_views_or_under_the_ground_is_refused(folder):
    stated = {"dataset": SCENE["dataset"] | {"scene": {"views": [{"height_m": 200, "reach_m": 150}]}}}
    (folder / "small.yaml").write_text(yaml.safe_dump(stated))
    for place, message in (("400,0,300", "|x| and |y| at most"), ("0,0,0.2", "above the ground")):
        (folder / "off.csv").write_text("\n".join(["# frame: O_L", NAMES, f"0,{place},{DOWN}", ""]))
        done = frames(folder, out="none", poses="off.csv", scene="small.yaml")
        assert done.returncode == 2
        assert message in " ".join(done.stderr.split())
        assert not (folder / "none").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width: 64\n", "camera.yaml: camera.width: got an unknown key, expected width_px"),
        ("width_px: 0\n", "width_px: got 0"),
        ("[1, 2]\n", "camera: got list"),
    ],
)
def test_a_faulty_camera_is_refused(folder, text, message):
    shutil.copy(folder / "camera.yaml", folder / "kept.yaml")
    (folder / "camera.yaml").write_text(text)
    done = frames(folder, out="none")
    shutil.move(folder / "kept.yaml", folder / "camera.yaml")
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())


def test_other_commands_refuse_a_given_scene(folder):
    done = in_process.call(main, "dataset", "--config", folder / "scene.yaml", "--out", folder / "none")
    assert done.returncode == 2
    assert "perilune-render frames" in " ".join(done.stderr.split())
