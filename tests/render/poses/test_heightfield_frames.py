"""The command `frames` with the engine `heightfield`: Suns that alternate, hazard channels, errors with their lines."""

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from tests.helpers import in_process
from tests.helpers.elevation_models import POLAR, write

from perilune_render.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.validation.validate import validate

NAMES = "time_s,x_m,y_m,z_m,qw,qx,qy,qz"
PIT = POLAR, rasterio.Affine(10, 0, 1e5, 0, -10, 0)
VIEWS = [{"height_m": 100, "reach_m": 150}, {"height_m": 300, "reach_m": 300}]


def written(folder, names, rows, **changes):
    """Poses, scene and camera; the arguments of a command."""
    scene = {
        "terrain": {"spacing_px": 2.0},
        "render": {"samples": 1, "engine": "heightfield"},
        "camera": {"width_px": 48, "height_px": 32},
        "scene": {"sun_elevation_deg": 30, "views": VIEWS},
    }
    (folder / "poses.csv").write_text("\n".join(["# frame: O_L", names, *rows, ""]))
    (folder / "scene.yaml").write_text(yaml.safe_dump({"dataset": scene | changes}))
    return "--poses", folder / "poses.csv", "--scene", folder / "scene.yaml", "--preset", "tiny"


def frames(folder, arguments):
    return in_process.call(main, "frames", *arguments, "--out", folder / "out", "--workers", 0)


def test_suns_that_alternate_make_two_scenes_of_a_valid_dataset(tmp_path):
    rows = [f"{5 + k},0,0,200,0,1,0,0,{90 + 20 * (k % 2)},30" for k in range(4)]
    done = frames(tmp_path, written(tmp_path, f"{NAMES},sun_azimuth_deg,sun_elevation_deg", rows))
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "out")
    assert validate(made) == []
    rows = made.table("frames").sort_by("frame_id").to_pylist()
    assert [(row["scene_id"], row["frame_index"], row["time_s"]) for row in rows] == [
        ("scene-0000", 0, 0),
        ("scene-0000", 2, 2),
        ("scene-0001", 1, 1),
        ("scene-0001", 3, 3),
    ]
    done = in_process.call(main, "regenerate", "--manifest", tmp_path / "out", "--verify", "--all")
    assert done.returncode == 0 and "4 frames: 4 identical" in done.stdout


@pytest.mark.parametrize(("z_m", "message"), [(-1, "line 4: pose at 1 s: got z -1.0"), (0.5, "line 4: got a camera")])
def test_the_line_of_a_pose_that_does_not_fit_is_named(tmp_path, z_m, message):
    rows = ["0,0,0,200,0,1,0,0", f"1,0,0,{z_m},0,1,0,0"]
    scene = {"sun_elevation_deg": 30} | ({"views": VIEWS} if z_m > 0 else {})
    done = frames(tmp_path, written(tmp_path, NAMES, rows, scene=scene))
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert not (tmp_path / "out" / "dataset.json").exists()


@pytest.mark.slow
def test_frames_and_preview_warn_of_each_sun_that_leaves_the_site_in_shadow(tmp_path):
    column, row = np.meshgrid(np.arange(300) + 0.5, np.arange(300) + 0.5)
    dem = write(tmp_path / "pit.tif", -120 * np.clip(1 - (np.hypot(column - 150, row - 150) / 30) ** 2, 0, None), *PIT)
    rows = [f"{k},{20 * k},0,{250 - 30 * k},0,1,0,0,{90 * k},{sun}" for k, sun in enumerate((15, 60, 10))]
    arguments = written(tmp_path, f"{NAMES},sun_azimuth_deg,sun_elevation_deg", rows)
    out = [("--out", tmp_path / name, "--workers", n) for n, name in enumerate(("here", "worker"))]
    commands = [*(("frames", *where) for where in out), ("preview", "--out", tmp_path / "p.png")]
    for command in commands:
        done = in_process.call(main, command[0], *arguments, "--dem", dem, *command[1:])
        assert done.returncode == 0, done.stderr
        found = [line.split(":")[1].strip() for line in done.stderr.splitlines() if "lies in shadow" in line]
        assert found == ["scene-0000", "scene-0002"]
    picture = cv2.imread(str(tmp_path / "p-map.png"))
    assert picture.shape[:2] == (940, 1280)
    track = (np.abs(picture[20:920, 20:920].astype(int) - [40, 160, 255]) < 30).all(axis=-1)
    assert 20 < track.sum() < 2000  # the poses of all three Suns, near the site


def test_preview_refuses_a_scene_without_poses(tmp_path):
    arguments = written(tmp_path, NAMES, ["0,0,0,200,0,1,0,0"])
    done = in_process.call(main, "preview", arguments[3], "--out", tmp_path / "p.png")
    assert done.returncode == 2 and "preview --poses" in done.stderr
    done = in_process.call(main, "preview", *arguments[2:], "--out", tmp_path / "p.png")
    assert done.returncode == 2 and "--poses as well" in done.stderr
