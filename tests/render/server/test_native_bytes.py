"""Frames and labels of our own interface are byte for byte those of `perilune-render frames`."""

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from tests.helpers import in_process
from tests.render.server.native_running import NativeRunning

from perilune_render.cli.main import main
from perilune_render.cli.options import resolved_config
from perilune_render.server.grounds import Grounds
from perilune_render.server.simulation import open_simulation
from perilune_shared.client import SceneClient
from perilune_shared.dataset.manifest import open_dataset

NAMES = (
    "time_s,x_m,y_m,z_m,qw,qx,qy,qz,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps,sun_azimuth_deg,sun_elevation_deg"
)
DOWN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
"""Attitude of a camera that looks straight down."""
ATTITUDES_DEG = ((0, 0, 0), (4, -6, 30), (-8, 3, 200), (2, 9, -75))
"""Turns of the camera from DOWN about its own axes, degrees."""
SUNS_DEG = ((90.0, 20.0), (90.0, 20.0), (250.5, 35.25), (12.0, 8.0))


def poses():
    """Rows of NAMES: positions, attitudes, velocities and Suns all differ."""
    for k, (turn, sun) in enumerate(zip(ATTITUDES_DEG, SUNS_DEG, strict=True)):
        x, y, z, w = (Rotation.from_euler("xyz", turn, degrees=True) * DOWN).as_quat().tolist()
        position, velocity = (3.0 * k, -20.0, 400.0 - 50 * k), (5.0 - k, 3.0 * k, -50.0)
        yield (float(k), *position, w, x, y, z, *velocity, 0.3, -0.2 * k, 0.5, *sun)


@pytest.fixture(scope="module")
def made_and_served(tmp_path_factory):
    """The dataset that `frames` makes of the poses, and the frames that a client gets for them."""
    folder = tmp_path_factory.mktemp("frames")
    settings = {
        "name": "given",
        "seed": 5,
        "camera": {"width_px": 64, "height_px": 48, "distortion": {"k1": -0.05}},
        "sensor": {"row_time_s": 2e-4, "blur_poses": 2},
        "terrain": {"spacing_px": 2.0},
        "render": {"samples": 2, "engine": "heightfield"},
        "scene": {"views": [{"height_m": 150, "reach_m": 200}, {"height_m": 1000, "reach_m": 500}]},
    }
    scene, rows = folder / "scene.yaml", list(poses())
    scene.write_text(yaml.safe_dump({"dataset": settings}))
    lines = [",".join(map(repr, row)) for row in rows]
    (folder / "poses.csv").write_text("\n".join(["# frame: O_L", NAMES, *lines, ""]))
    command = ["--poses", folder / "poses.csv", "--scene", scene, "--preset", "tiny", "--out", folder / "out"]
    done = in_process.call(main, "frames", *command, "--workers", 0)
    assert done.returncode == 0, done.stderr
    config = resolved_config("tiny", scene, None, None, None, given_scene=True)
    with (
        open_simulation(config) as simulated,
        NativeRunning(Grounds(simulated)) as running,
        SceneClient(running.address) as client,
    ):
        served = [
            client.frame(
                row[1:4],
                row[4:8],
                velocity_mps=row[8:11],
                angular_velocity_radps=row[11:14],
                sun_deg=row[14:],
                labels=True,
            )
            for row in rows
        ]
        still = client.frame(rows[0][1:4], rows[0][4:8], velocity_mps=rows[0][8:11], index=0, sun_deg=rows[0][14:])
    return folder / "out", open_dataset(folder / "out"), served, still


def test_images_are_those_of_the_command_frames(made_and_served):
    folder, made, served, still = made_and_served
    rows = made.table("frames").sort_by("frame_index").to_pylist()
    assert len({row["scene_id"] for row in rows}) == 3
    for row, frame in zip(rows, served, strict=True):
        stored = cv2.imread(str(folder / row["png_path"]), cv2.IMREAD_UNCHANGED)
        assert (stored == frame.image).all()
    assert (still.image != served[0].image).any()  # the angular velocity has an effect


def test_labels_are_those_of_the_command_frames(made_and_served):
    _, made, served, _ = made_and_served
    rows, labels = made.table("frames").sort_by("frame_index").to_pylist(), made.table("labels")
    for row, frame in zip(rows, served, strict=True):
        own = labels.filter([name == row["frame_id"] for name in labels["frame_id"].to_pylist()])
        assert own.num_rows > 5
        assert set(frame.labels) == set(labels.column_names) - {"frame_id", "scene_id", "split"}
        for name, column in frame.labels.items():
            stored = own[name].to_numpy()
            assert stored.dtype == column.dtype, name
            np.testing.assert_array_equal(stored, column, err_msg=name)
