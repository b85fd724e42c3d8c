"""The distance of features from those of training frames: fit, limit, file."""

import json

import numpy as np
import pytest
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.errors import UserError
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.split_evaluation import novel_entries
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.detect.inference.tiles import detect_image
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.detect.novelty import (
    fit_gaussian,
    fit_training_features,
    is_novel,
    read_training_features,
    write_training_features,
)


def correlated(count, seed=0, size=6):
    """Features of two strong directions and weak noise, with different units."""
    rng = np.random.default_rng(seed)
    mixing = np.random.default_rng(99).standard_normal((2, size))
    return (rng.standard_normal((count, 2)) @ mixing + 0.1 * rng.standard_normal((count, size))) * 10.0 ** np.arange(
        size
    ) + 5


def test_the_distance_is_that_of_mahalanobis():
    """With all components, it is (x - mean)^T covariance^-1 (x - mean)."""
    features, other = correlated(400), correlated(20, seed=1)
    gaussian = fit_gaussian(features)
    assert gaussian.directions.shape == (5, 6)
    centred = other - features.mean(axis=0)
    exact = np.sqrt(np.einsum("ni,ij,nj->n", centred, np.linalg.inv(np.cov(features.T, bias=True)), centred))
    assert gaussian.distance(other) == pytest.approx(exact, rel=1e-3)


def test_a_step_across_the_spread_counts_more_than_one_along_it():
    features = correlated(400)
    gaussian = fit_gaussian(features)
    along, across = np.linalg.svd((features - gaussian.mean) / gaussian.deviation)[2][[0, -1]]
    steps = gaussian.mean + gaussian.deviation * np.array([along, across])
    near, far = gaussian.distance(steps)
    assert far > 10 * near


def test_the_limit_is_kept_by_99_percent_of_left_out_scenes():
    scenes = np.repeat(np.arange(40), 10)
    # Frames of a scene are alike, so only scenes that were left out tell what new frames look like.
    own = correlated(40, seed=2)[scenes] + 0.1 * correlated(400, seed=3)
    fit = fit_training_features(own, scenes)
    fresh = correlated(400, seed=4) + 0.1 * correlated(400, seed=5)
    assert fit.n_frames == 400 and (fit.novelty(own) > 1).mean() <= 0.01
    assert (fit.novelty(fresh) > 1).mean() < 0.05
    shifted = fresh + 30 * np.eye(6)[0]
    assert (fit.novelty(shifted) > 1).all()


@pytest.mark.parametrize(("count", "scenes"), [(7, 7), (40, 1)])
def test_too_few_frames_or_scenes_have_no_fit(count, scenes):
    assert fit_training_features(correlated(count), np.arange(count) % scenes) is None


def test_few_frames_and_constant_features_have_finite_distances():
    features = np.column_stack([correlated(8), np.zeros(8), np.full(8, 1e5)])
    fit = fit_training_features(features, np.arange(8) % 2)
    assert np.isfinite(fit.novelty(features + 1)).all()


def test_unknown_novelty_is_no_alarm():
    assert [is_novel(value) for value in (None, np.nan, 0.99, 1.0, 1.01)] == [False, False, False, False, True]


def with_novelty(*values):
    return [Detections(np.zeros((0, 4)), np.zeros(0), novelty=value) for value in values]


def test_evaluations_have_the_share_of_alarms():
    assert novel_entries(with_novelty(0.5, 1.5, 0.2, 0.9), "test/") == {"test/novel_share": 0.25}
    assert novel_entries(with_novelty(None, None), "test/") == {}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose training features come from noise, and its detector."""
    folder = store_run(tmp_path_factory.mktemp("run"))
    plain = open_run(folder, settings_of(folder))
    images = np.random.default_rng(0).integers(60, 180, (24, 128, 128)).astype(np.uint8)
    fit = fit_training_features(plain.features(images), np.arange(24) % 6)
    write_training_features(folder, fit)
    return folder, fit


def test_the_file_keeps_the_fit_and_is_small(run):
    folder, fit = run
    network = open_run(folder, settings_of(folder)).network
    stored = read_training_features(folder, network.n_features)
    features = np.random.default_rng(1).standard_normal((5, network.n_features))
    assert np.array_equal(stored.novelty(features), fit.novelty(features)) and stored.n_frames == 24
    assert (folder / "novelty.json").stat().st_size < 50_000


def frames_of_two_kinds():
    """Noise, as in the fit, and a smooth slope."""
    noise = np.random.default_rng(2).integers(60, 180, (128, 128)).astype(np.uint8)
    return np.stack([noise, np.tile(np.linspace(0, 255, 128), (128, 1)).astype(np.uint8)])


def test_an_image_has_the_novelty_of_its_frame(run):
    """Frames and images give the same value: both look at scale 1 only, in the pass that detects."""
    folder, fit = run
    settings = settings_of(folder, "detect.evaluation.scales=[0.5,1]")
    detector, frames = open_run(folder, settings), frames_of_two_kinds()
    expected = fit.novelty(detector.features(frames))
    assert expected[0] < 1 < expected[1]
    found = detect_at_scales(detector, frames)
    assert [part.novelty for part in found] == pytest.approx(expected)
    for frame, value in zip(frames, expected, strict=True):
        tiling = Tiling(128, 0, scales=(1.0, 0.5))
        assert detect_image(detector, frame, tiling).novelty == pytest.approx(value)
        # Four tiles, of which one differs: the median stays.
        large = np.tile(frame, (2, 2))
        large[:128, :128] = frames[0]
        assert detect_image(detector, large, tiling).novelty == pytest.approx(value)
    assert detect_image(detector, frames[0], Tiling(128, 0, scales=(0.5,))).novelty is None


def test_boxes_and_scores_do_not_depend_on_it(run, tmp_path):
    folder, _ = run
    detector, frames = open_run(folder, settings_of(folder)), frames_of_two_kinds()
    for plain, same in zip(detector.predict(frames), detector.predict_with_novelty(frames)[:3], strict=True):
        assert (plain is None and same is None) or bool((plain == same).all())
    without = store_run(tmp_path)
    assert open_run(without, settings_of(without)).predict_with_novelty(frames)[3] is None


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"limit": 0}, "content"),
        ({"limit": float("nan")}, "content"),
        ({"mean": [1.0]}, "mean"),
        ({"mean": "text"}, "content"),
        ({"variances": [1e400]}, "directions"),
        ({"directions": "AAAAAA=="}, "directions"),
        ({"directions": "not base64"}, "content"),
        ({"deviation": None}, "mean"),
    ],
)
def test_a_damaged_file_is_refused(run, tmp_path, change, field):
    folder, _ = run
    content = json.loads((folder / "novelty.json").read_text()) | change
    (tmp_path / "novelty.json").write_text(json.dumps(content))
    n_features = open_run(folder, settings_of(folder)).network.n_features
    with pytest.raises(UserError, match=f"novelty.json: {field}: "):
        read_training_features(tmp_path, n_features)
