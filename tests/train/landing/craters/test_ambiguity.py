"""Probability that a match is correct."""

import numpy as np
from tests.train.landing.craters.crater_world import CAMERA, pose, sighted, world

from perilune_train.landing.craters.ambiguity import match_probability
from perilune_train.landing.craters.catalogue import Catalogue, CatalogueErrors, with_errors
from perilune_train.landing.craters.fix import Fix, PosePrior, refine
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings

DOWN = Pose(np.array([0.0, 0.0, 500.0]), np.diag([1.0, -1.0, -1.0]))


def probability(xy_m, radius_m, matched):
    """Probability that the sighting at the image centre shows crater `matched`, the only match of a fix."""
    n = len(radius_m)
    centre = np.column_stack([np.array(xy_m, float), np.zeros(n)])
    catalogue = Catalogue(centre, np.tile([0.0, 0, 1], (n, 1)), np.array(radius_m, float), 1.0, 0.03)
    size_px = projected(catalogue, CAMERA, DOWN).radius_px[0]
    middle = np.array([[CAMERA.cx_px, CAMERA.cy_px]])
    seen = Sightings(middle, np.array([size_px]), np.array([0.8]))
    fix = Fix(DOWN, np.eye(6), np.array([0]), np.array([matched]), np.ones(1), 0.1, DOWN)
    (found,) = match_probability(seen, catalogue, CAMERA, fix)
    return found


def test_a_crater_without_neighbours_is_certain():
    assert probability([[0, 0], [60, 0]], [8, 8], 0) > 0.99
    # Its neighbour is much larger than the sighting.
    assert probability([[0, 0], [1, 0]], [8, 24], 0) > 0.99


def test_two_craters_of_one_size_beside_a_sighting():
    both = [[0.5, 0], [-0.5, 0]]
    assert abs(probability(both, [8, 8], 0) - 0.5) < 0.01
    assert abs(probability(both, [8, 8], 1) - 0.5) < 0.01
    nearer = probability([[0, 0], [2.5, 0]], [8, 8], 0)
    assert 0.6 < nearer < 0.999
    assert probability([[0, 0], [2.5, 0]], [8, 8], 1) < 1 - nearer + 1e-9


def test_wrong_matches_among_dense_craters_are_mostly_ambiguous():
    n_wrong, n_likely_wrong, n_likely = 0, 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        dense = world(seed, side_m=900.0, least_m=4.0, per_m2=0.25)
        errors = CatalogueErrors(missing_share=0.0, false_share=0.0)
        catalogue = with_errors(dense, errors, rng)
        true = pose(rng, 300.0, reach_m=100.0)
        visible = projected(dense, CAMERA, true)
        seen = sighted(dense, true, rng, false_share=0.0, most=400)
        fix = refine(seen, catalogue, CAMERA, PosePrior(true, np.eye(6) * 1e4), true)
        assert fix is not None
        likely = match_probability(seen, catalogue, CAMERA, fix) >= 0.8
        # The true crater of a sighting is the nearest one of its size in the exact catalogue.
        apart = np.linalg.norm(visible.centre_px[None] - seen.centre_px[fix.sighting][:, None], axis=2)
        apart += 10 * np.abs(np.log(visible.radius_px[None] / seen.radius_px[fix.sighting][:, None]))
        wrong = visible.index[apart.argmin(axis=1)] != fix.crater
        n_wrong, n_likely_wrong = n_wrong + wrong.sum(), n_likely_wrong + (wrong & likely).sum()
        n_likely += likely.sum()
    assert n_wrong > 30
    assert n_likely > 200
    assert n_likely_wrong < 0.35 * n_wrong
