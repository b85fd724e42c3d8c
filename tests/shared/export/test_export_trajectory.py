"""Exported trajectories, read by evo, have no error against the manifest."""

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from evo.tools import file_interface
from rich.progress import Progress

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.export.trajectory import export_kitti, export_tum
from perilune_shared.geometry.camera import Camera

TRAJECTORIES = ["s000/t000", "s001/t001", "s002/t002", "s003/t003"]


@pytest.fixture(scope="module")
def files(crowded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trajectories")
    with Progress(disable=True) as progress:
        assert export_tum(open_dataset(crowded), folder / "tum", progress) == 4
        assert export_kitti(open_dataset(crowded), folder / "kitti", progress) == 4
    return folder


def ground_truth(root, trajectory) -> PoseTrajectory3D:
    """Return the poses of the manifest, O_C to O_L, built by evo from quaternions (w, x, y, z)."""
    scene, trajectory = trajectory.split("/")
    frames = open_dataset(root).table("frames", scene_id=scene, trajectory_id=trajectory).to_pandas()
    w, x, y, z = np.stack(frames["rotation_wxyz"]).T
    return PoseTrajectory3D(
        positions_xyz=np.stack(frames["position_m"]),
        orientations_quat_wxyz=np.column_stack([w, -x, -y, -z]),
        timestamps=frames["time_s"].to_numpy(),
    )


def largest_error(reference, estimate, relation) -> float:
    error = metrics.APE(relation)
    error.process_data((reference, estimate))
    return error.get_statistic(metrics.StatisticsType.max)


RELATIONS = [metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg]


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize("relation", RELATIONS)
def test_tum_has_no_error(crowded, files, trajectory, relation):
    found = file_interface.read_tum_trajectory_file(files / f"tum/{trajectory}.txt")
    assert found.check()[0] and found.num_poses == 5
    expected = ground_truth(crowded, trajectory)
    assert np.array_equal(found.timestamps, expected.timestamps)
    assert largest_error(expected, found, relation) < 1e-6
    other = ground_truth(crowded, next(name for name in TRAJECTORIES if name != trajectory))
    assert largest_error(other, found, relation) > 0.1


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize("relation", RELATIONS)
def test_kitti_has_no_error(crowded, files, trajectory, relation):
    found = file_interface.read_kitti_poses_file(files / f"kitti/{trajectory}.txt")
    assert found.check()[0] and found.num_poses == 5
    expected = ground_truth(crowded, trajectory)
    times = np.loadtxt(files / f"kitti/{trajectory}.times.txt")
    assert np.array_equal(times, expected.timestamps)
    # The reference is the first camera.
    first = np.linalg.inv(expected.poses_se3[0])
    relative = PosePath3D(poses_se3=[first @ pose for pose in expected.poses_se3])
    assert np.allclose(found.poses_se3[0], np.eye(4), atol=1e-12)
    assert largest_error(relative, found, relation) < 1e-6


def test_poses_transform_from_camera_to_site(crowded, files):
    """The inverse of a pose of the file projects a crater to the centre of its label."""
    dataset = open_dataset(crowded)
    pose = file_interface.read_tum_trajectory_file(files / "tum/s000/t000.txt").poses_se3[0]
    craters = dataset.table("craters", scene_id="s000").to_pandas().set_index("crater_id")
    labels = dataset.table("labels", scene_id="s000", trajectory_id="t000").to_pandas()
    labels = labels[labels["frame_id"] == "s000/t000/000000"]
    labels = labels[labels["radius_px"] < 6]
    camera: Camera = dataset.camera
    points = craters.loc[labels["crater_id"], ["x_m", "y_m", "z_m"]].to_numpy()
    seen = camera.project((points - pose[:3, 3]) @ pose[:3, :3])
    assert len(labels) > 3
    assert np.allclose(seen, labels[["ellipse_cx_px", "ellipse_cy_px"]], atol=0.1)


def test_one_split(crowded, tmp_path):
    with Progress(disable=True) as progress:
        assert export_tum(open_dataset(crowded), tmp_path / "tum", progress, split="val") == 1
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.txt")] == ["tum/s002/t002.txt"]
