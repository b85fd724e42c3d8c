import numpy as np
import pytest

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_train.explain import correlation

_RINGS = (1.1, 1.2, 1.3, 1.4)


def test_pearson_by_hand():
    # Deviations (-1.5, -0.5, 0.5, 1.5) and (-1, 1, -1, 1): 2 / sqrt(5 * 4).
    assert correlation.pearson([1, 2, 3, 4], [0, 2, 0, 2]) == pytest.approx(2 / np.sqrt(20))


def test_pearson_knows_no_gain_and_offset_and_keeps_the_sign():
    image = np.random.default_rng(0).random((5, 6))
    assert correlation.pearson(image, 3 * image + 7) == pytest.approx(1)
    assert correlation.pearson(image, -image) == pytest.approx(-1)


def test_pearson_over_seen_pixels_only():
    a, b = np.array([[1.0, 2, 3, 99]]), np.array([[1.0, 2, 3, -99]])
    assert correlation.pearson(a, b, np.array([[True, True, True, False]])) == pytest.approx(1)
    assert correlation.pearson(a, b) < -0.9


@pytest.mark.parametrize("level", [0.0, 1.0, 0.1])
def test_a_constant_mask_has_no_correlation(level):
    flat = np.full((64, 64), level, np.float32)
    assert np.isnan(correlation.pearson(flat, np.random.default_rng(0).random((64, 64))))


def test_pearson_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"\(2, 2\).*\(3, 3\)"):
        correlation.pearson(np.eye(2), np.eye(3))


def test_pcc2_leaves_out_the_image_itself_and_the_undefined():
    a = np.array([[0.0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [2, 2, 2, 2]])
    between = correlation.pearson_between(a)
    np.testing.assert_allclose(between[:3, :3], [[1, -1, 1], [-1, 1, -1], [1, -1, 1]], atol=1e-12)
    value, undefined = correlation.mean_between(between)
    assert value == pytest.approx(-1 / 3)  # (-1, 1, -1, -1, 1, -1) / 6
    assert undefined == 6
    value, undefined = correlation.mean_defined([np.nan, np.nan])
    assert np.isnan(value) and undefined == 2


def test_ground_truth_mask_has_the_papers_rings():
    mask = correlation.ground_truth_mask(101, 101, [[50.5, 50.5]], [20.0], _RINGS)
    # Pixel (50, 50 + k) has its centre k pixels from the crater's: 20 px radius, rings of 2 px.
    assert [mask[50, 50 + k] for k in (0, 20, 21, 22, 23, 25, 27, 28, 29)] == pytest.approx(
        [0, 0, 0.2, 0.2, 0.4, 0.6, 0.8, 0.8, 1]
    )
    assert mask[50, 50 - 27] == pytest.approx(0.8) and mask[50 + 25, 50] == pytest.approx(0.6)


def test_overlapping_craters_take_the_least_and_edges_are_safe():
    both = correlation.ground_truth_mask(60, 40, [[20, 20], [32, 20], [-100, 5], [59, 39]], [10, 10, 3, 8], _RINGS)
    one = correlation.ground_truth_mask(60, 40, [[20, 20]], [10], _RINGS)
    two = correlation.ground_truth_mask(60, 40, [[32, 20], [59, 39]], [10, 8], _RINGS)
    np.testing.assert_array_equal(both, np.minimum(one, two))
    assert np.all(correlation.ground_truth_mask(8, 8, np.zeros((0, 2)), [], _RINGS) == 1)


def test_ground_affine_follows_a_level_descent_exactly():
    camera = Camera(128, 128, 150, 150, 64, 64)
    first, second = np.array([0.0, 0, 1000]), np.array([50.0, -20, 800])
    affine = correlation.ground_affine(camera, first, ROTATION_CAMERA_FROM_BODY, second, ROTATION_CAMERA_FROM_BODY)
    # Level views of a plane differ by a scale 1000 / 800 and a shift.
    np.testing.assert_allclose(affine[:, :2], np.diag([1.25, 1.25]), atol=1e-9)
    point = np.array([[120.0, 35, 0]])
    before, after = (camera.project(camera_from_site(point, p, ROTATION_CAMERA_FROM_BODY))[0] for p in (first, second))
    np.testing.assert_allclose(affine @ [*before, 1], after, atol=1e-9)


def test_a_moved_mask_matches_again():
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    waves = rng.uniform(-0.4, 0.4, (6, 2))

    def pattern(x, y):
        return sum(np.sin(a * x + b * y) for a, b in waves)

    affine = np.array([[1.1, 0.02, 3.0], [-0.01, 1.2, -6.0]])
    later = pattern(u, v)
    earlier = pattern(*(affine[i, 0] * u + affine[i, 1] * v + affine[i, 2] for i in (0, 1)))
    moved, seen = correlation.warped_mask(later, affine)
    assert correlation.pearson(earlier, moved, seen) > 0.99
    assert correlation.pearson(earlier, later) < 0.5
    assert 0.5 < seen.mean() < 1 and not seen[0].any() and seen[32, 32]
