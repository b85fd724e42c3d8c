import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.navigate.data import load_descents
from perilune_train.navigate.klt import klt_descent, klt_motion
from perilune_train.navigate.metrics import motion_errors, summary


@pytest.fixture(scope="module")
def descents(make_dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("klt") / "nav"
    return load_descents(
        open_dataset(
            make_dataset(
                folder,
                "nav",
                side_px=160,
                n_frames=16,
                splits={"train": 1, "val": 1, "test": 1},
                scenes=1,
                craters=600,
                jitter_m=15.0,
            )
        )
    )


def test_tracks_find_the_motion_far_better_than_the_nominal_curve(descents):
    found = summary(motion_errors(descents, [klt_descent(d) for d in descents]))
    nominal = summary(motion_errors(descents, [d.nominal_motion for d in descents]))
    assert found["position_rmse_vector_m"] < 0.5 * nominal["position_rmse_vector_m"]
    assert found["orientation_rmse_angle_deg"] < 0.3
    assert found["orientation_rmse_z_deg"] < 0.05


def test_a_featureless_ground_gives_the_nominal_motion(descents):
    d = descents[0]
    blank = np.full_like(d.images[0], 90)
    shift, turn = np.array([1.0, 2, 30]), np.eye(3)
    translation, rotation, tracks = klt_motion(d.camera, blank, blank, shift, turn, d.down_c, 800.0)
    assert tracks == 0
    np.testing.assert_array_equal(translation, shift)
    np.testing.assert_array_equal(rotation, turn)


def test_without_motion_the_same_frame_gives_none(descents):
    d = descents[0]
    start = np.array([4.0, -3.0, 5.0])
    translation, rotation, tracks = klt_motion(d.camera, d.images[0], d.images[0], start, np.eye(3), d.down_c, 1400.0)
    assert tracks > 30
    np.testing.assert_allclose(translation, 0, atol=1.0)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-3)
