import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.motion.classical.alignment import aligned_trajectory
from perilune_train.motion.classical.klt import klt_trajectory
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.metrics.errors import motion_errors, summary


@pytest.fixture(scope="module")
def trajectories(make_dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("aligned") / "nav"
    made = make_dataset(
        folder,
        "nav",
        side_px=160,
        n_frames=12,
        splits={"val": 1, "test": 1},
        scenes=1,
        craters=600,
        jitter_m=15.0,
    )
    return [load_split(open_dataset(made), split)[0] for split in ("val", "test")]


def test_alignment_is_better_than_tracks_and_best_with_a_gyroscope(trajectories):
    tracked, aligned, aided = (
        summary(motion_errors(trajectories, [method(one) for one in trajectories]))
        for method in (
            lambda one: klt_trajectory(one).motion,
            lambda one: aligned_trajectory(one).motion,
            lambda one: aligned_trajectory(one, one.gyroscopes["tactical"]).motion,
        )
    )
    assert aligned["position_rmse_vector_m"] < 0.7 * tracked["position_rmse_vector_m"]
    assert aided["position_rmse_vector_m"] < 0.5 * aligned["position_rmse_vector_m"]
    assert aided["orientation_rmse_angle_deg"] < 0.02
