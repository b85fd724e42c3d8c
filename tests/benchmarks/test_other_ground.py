import numpy as np
import pytest

from benchmarks.scene.other_ground import PIXEL_M, SIDE_PX, _crest_m
from perilune_shared.geometry.frames import Array

X_M, Y_M, CREST_M = 300.0, -200.0, 60.0


@pytest.fixture(scope="module")
def crater() -> Array:
    """Height map of a crater of depth 20 m on a plane that rises by 5 % to the east."""
    west = (SIDE_PX / 2 - 0.5 - np.arange(SIDE_PX)) * PIXEL_M
    distance = np.hypot(west - X_M, (-west - Y_M)[:, None]) / CREST_M
    return np.where(distance < 1, 20 * distance**2 - 20, 3 * (1 - distance)) - 0.05 * west


@pytest.mark.parametrize("listed_m", [45.0, 60.0, 75.0])
def test_the_crest_is_found_about_the_listed_centre_whatever_the_listed_radius(crater, listed_m):
    assert _crest_m(crater, X_M, Y_M, listed_m) == pytest.approx(CREST_M, abs=PIXEL_M)


def test_a_place_without_a_crater_and_one_at_the_edge_have_no_crest(crater):
    assert _crest_m(crater, -X_M, Y_M, CREST_M) is None
    assert _crest_m(crater, PIXEL_M * SIDE_PX / 2, Y_M, CREST_M) is None
