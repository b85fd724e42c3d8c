"""Several cameras with a rolling shutter on a turning body: each row of each camera has its own pose."""

import json

import numpy as np
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.flight.sub_poses import moved, row_times_s
from perilune_render.imaging.exr import read_exr
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import camera_from_site
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate

ROW_TIME_S = 3e-3
CONFIG = {
    "name": "rolling-stereo",
    "terrain": {"spacing_px": 2.0, "boulders": {"density": 0.0}},
    "render": {"exr": True, "engine": "heightfield", "samples": 1},
    "sensor": {"row_time_s": ROW_TIME_S},
    "cameras": {
        "nav": {"width_px": 96, "height_px": 96},
        "wide": {
            "width_px": 96,
            "height_px": 64,
            "horizontal_fov_deg": 70,
            "mounting": {"position_in_body_m": [8.0, 0.5, -0.3], "turned_deg": [15, 3, 10]},
        },
    },
}
POSES = """# frame: O_L
time_s,x_m,y_m,z_m,qw,qx,qy,qz,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps
0,0,-20,300,0,1,0,0,60,-30,-40,0.3,-0.2,1.5
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rolling")
    (folder / "poses.csv").write_text(POSES)
    (folder / "scene.yaml").write_text(json.dumps({"dataset": CONFIG}))
    files = ["--poses", folder / "poses.csv", "--scene", folder / "scene.yaml", "--out", folder / "out"]
    done = in_process.call(main, "frames", *files, "--preset", "tiny", "--workers", 0)
    assert done.returncode == 0, done.stderr
    return folder / "out"


@pytest.fixture
def rolling(folder):
    return open_dataset(folder)


def row_poses(row, height_px):
    """The pose of each row, from the pose and the velocities that the manifest states for the frame."""
    rotation = matrix_from_quaternion(row["rotation_wxyz"])
    velocity = np.asarray(row["velocity_mps"])
    turn = np.array([row[f"w{axis}_radps"] for axis in "xyz"])
    times = row_times_s(height_px, ROW_TIME_S)
    return [moved((np.asarray(row["position_m"]), rotation), velocity, turn, time) for time in times]


def ground(dataset, row, camera, poses):
    """Points of the ground that each pixel shows (h, w, 3), O_L, by the EXR's depth and these poses."""
    rays = camera.rays(camera.pixel_centres()) * read_exr(dataset.file(row["exr_path"]))["Z"][..., None]
    return np.stack([ray @ rotation + position for ray, (position, rotation) in zip(rays, poses, strict=True)])


def depth_error(dataset, first, second, rolling):
    """Relative differences of the depths at which both cameras see the same points of the ground."""
    cameras = [dataset.camera_of(row) for row in (first, second)]
    poses = [row_poses(row, camera.height_px) for row, camera in zip((first, second), cameras, strict=True)]
    if not rolling:
        poses = [[own[len(own) // 2]] * len(own) for own in poses]
    points = ground(dataset, first, cameras[0], poses[0]).reshape(-1, 3)
    depth = read_exr(dataset.file(second["exr_path"]))["Z"]
    found = []
    for k, pose in enumerate(poses[1]):
        seen = camera_from_site(points, *pose)
        column, row = np.floor(cameras[1].project(seen)).T
        shown = (row == k) & (column >= 0) & (column < cameras[1].width_px)
        found.append(np.abs(depth[k, column[shown].astype(int)] / seen[shown, 2] - 1))
    return np.concatenate(found)


def test_rows_of_both_cameras_see_the_same_ground(rolling):
    assert validate(rolling) == []
    first, second = (rolling.frames.set_index("camera", drop=False).loc[name] for name in ("nav", "wide"))
    exact, still = (depth_error(rolling, first, second, rows) for rows in (True, False))
    assert len(exact) > 0.4 * 96 * 96
    # Half a pixel beside the place, ground of moderate slope differs little in depth.
    assert np.median(exact) < 0.003 and np.quantile(exact, 0.95) < 0.02
    assert np.median(still) > 3 * np.median(exact)


def test_velocity_of_a_camera_away_from_the_centre_has_a_part_from_the_turn(rolling):
    first, second = (rolling.frames.set_index("camera", drop=False).loc[name] for name in ("nav", "wide"))
    velocity = [np.asarray(row["velocity_mps"]) for row in (first, second)]
    arm = np.asarray(second["position_m"]) - np.asarray(first["position_m"])
    turn = matrix_from_quaternion(first["rotation_wxyz"]).T @ [first[f"w{axis}_radps"] for axis in "xyz"]
    np.testing.assert_allclose(velocity[1] - velocity[0], np.cross(turn, arm), atol=1e-9)
    assert np.linalg.norm(velocity[1] - velocity[0]) > 1


def test_the_manifest_gives_the_same_bytes(folder):
    done = in_process.call(main, "regenerate", "--manifest", folder, "--verify", "--all")
    assert done.returncode == 0 and "2 frames: 2 identical" in done.stdout
