"""Sightings from boxes: all of them for a map, the strongest in flight."""

import numpy as np

from perilune_train.landing.craters.sightings import MAX_SIGHTINGS, Sightings


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
