"""Catalogues with the errors that a mission's have."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from tests.train.landing.craters.crater_world import world

from perilune_train.landing.craters.catalogue import Catalogue, CatalogueErrors, with_errors


def test_errors_have_their_sizes_and_shares():
    exact = world(least_m=30.0)
    errors = CatalogueErrors(position_sigma_m=1.5, diameter_sigma_share=0.05, missing_share=0.2, false_share=0.1)
    found = with_errors(exact, errors, np.random.default_rng(0))
    assert (found.position_sigma_m, found.radius_sigma_share) == (1.5, 0.05)
    distance, place = KDTree(exact.centre_m).query(found.centre_m)
    true = distance < 7
    n_true = round(0.9 * len(found))
    assert abs(n_true - 0.8 * len(exact)) < 4 * np.sqrt(0.16 * len(exact))
    shift = (found.centre_m[:n_true] - exact.centre_m[place[:n_true]])[true[:n_true]]
    assert abs(shift[:, :2].std() - 1.5) < 0.1
    ratio = np.log(found.radius_m[:n_true] / exact.radius_m[place[:n_true]])[distance[:n_true] < 3]
    assert abs(np.median(np.abs(ratio)) / 0.6745 - 0.05) < 0.02


def test_the_same_generator_gives_the_same_catalogue():
    one, two = (with_errors(world(), CatalogueErrors(), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one.centre_m, two.centre_m)


@pytest.mark.parametrize("count", [1, 10, 5000])
def test_the_ground_is_that_of_the_nearest_craters(count):
    rng = np.random.default_rng(5)
    centre = rng.uniform(-500, 500, (2000, 3))
    catalogue = Catalogue(centre, np.tile([0.0, 0, 1], (2000, 1)), np.full(2000, 5.0), 0.0, 0.0)
    place = np.array([120.0, -80.0, 900.0])
    distance = np.hypot(*(centre[:, :2] - place[:2]).T)
    assert catalogue.ground_m(place, count) == np.median(centre[np.argsort(distance)[:count], 2])
