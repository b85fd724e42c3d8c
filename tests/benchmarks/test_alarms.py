"""The benchmark of the alarm: its frames, its features and its figures."""

import numpy as np
import pytest

from benchmarks.train import alarms, other_bodies
from perilune_train.detect.inference.detector import open_run
from tests.helpers.stored_run import settings_of, store_run


def test_the_area_counts_pairs_and_half_of_the_ties():
    rng = np.random.default_rng(0)
    familiar, novel = rng.integers(0, 6, 40).astype(float), rng.integers(2, 9, 30).astype(float)
    pairs = novel[:, None] - familiar[None, :]
    assert alarms.area_under_roc(familiar, novel) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean())


@pytest.mark.parametrize("name", [*alarms.CHOICE, *alarms.TEST])
def test_variations_change_frames_of_8_bits(name):
    image = np.random.default_rng(0).integers(90, 160, (64, 64)).astype(np.uint8)
    change = (alarms.CHOICE | alarms.TEST)[name]
    changed = change(image, np.random.default_rng(1))
    assert changed.dtype == np.uint8 and changed.shape == image.shape and not np.array_equal(changed, image)
    if name.startswith("gain"):
        # No grey level wraps round.
        assert (changed >= image).all()


@pytest.mark.parametrize("draw", [*other_bodies.CHOICE.values(), *other_bodies.TEST.values()])
def test_textures_differ_and_use_the_grey_levels(draw):
    frames = other_bodies.frames_of(draw, 2, 96)
    assert frames.shape == (2, 96, 96) and frames.std(axis=(1, 2)).min() > 15
    assert not np.array_equal(*frames) and np.array_equal(frames, other_bodies.frames_of(draw, 2, 96))


def test_the_first_candidate_has_the_features_of_the_detector(tmp_path):
    """With two scales, only the pass in full size counts."""
    run = store_run(tmp_path)
    detector = open_run(run, settings_of(run, "detect.evaluation.scales=[0.5,1]"))
    frames = np.random.default_rng(0).integers(0, 256, (3, 96, 96)).astype(np.uint8)
    expected = detector.features(frames)
    recorder = alarms.Recorder(detector)
    for features in (recorder.features(frames), recorder.look(frames)[1]):
        assert np.allclose(alarms.of_candidate(features, alarms.INSTALLED), expected, atol=1e-5)
        assert all(len(features[name]) == 3 for names in alarms.CANDIDATES.values() for name in names)
