"""Sightings from boxes: all of them for a map, the strongest in flight; predicted standard deviations."""

import numpy as np

from perilune_train.landing.craters.sightings import (
    MAX_SIGHTINGS,
    PREDICTED_FLOOR_PX,
    PREDICTED_NOISE,
    PREDICTED_STATIC,
    Sightings,
)


def test_a_map_keeps_every_detection_and_a_flight_the_strongest():
    rng = np.random.default_rng(0)
    corner, size = rng.uniform(0, 4000, (1200, 2)), rng.uniform(4, 40, (1200, 1))
    scores = rng.uniform(0.5, 1, 1200)
    sightings = Sightings.of_boxes(np.concatenate([corner, corner + size], axis=1), scores)
    assert len(sightings) == 1200
    strongest = sightings.strongest()
    assert len(strongest) == MAX_SIGHTINGS
    assert strongest.score.min() >= np.sort(scores)[-MAX_SIGHTINGS]
    assert (np.diff(strongest.radius_px) <= 0).all()
    assert len(strongest.strongest(2000)) == MAX_SIGHTINGS


def test_predicted_deviations_replace_the_constants_where_there_are_any():
    boxes = np.array([[10.0, 10, 14, 14], [30, 30, 50, 50], [60, 60, 68, 68]])
    scores = np.array([0.9, 0.6, 0.7])
    predicted = np.array([[0.3, 0.4], [np.nan, np.nan], [1.0, 1.0]])
    usual, seen = Sightings.of_boxes(boxes, scores), Sightings.of_boxes(boxes, scores, predicted)
    np.testing.assert_array_equal(seen.radius_px, [10, 4, 2])
    np.testing.assert_allclose(seen.sigma_px, [np.nan, 1.0, np.sqrt(0.125)])
    # Without a prediction, the deviations follow from radius and score.
    assert seen.noise_px[0] == usual.noise_px[0] and seen.static_px[0] == usual.static_px[0]
    np.testing.assert_allclose(seen.noise_px[1:], np.hypot(PREDICTED_FLOOR_PX, PREDICTED_NOISE * seen.sigma_px[1:]))
    np.testing.assert_allclose(seen.static_px[1:], PREDICTED_STATIC * seen.sigma_px[1:])
    np.testing.assert_array_equal(seen.without_predictions().noise_px, usual.noise_px)
    # A part keeps the prediction of each sighting.
    np.testing.assert_array_equal(seen.part(np.array([2, 1])).sigma_px, seen.sigma_px[[2, 1]])
    assert seen.strongest(1).sigma_px[0] == seen.sigma_px[2]
    assert usual.sigma_px is None and usual.part(np.array([0])).sigma_px is None
