import numpy as np
import pytest
from scipy import ndimage

from perilune_train.explain.maps.baselines import (
    baseline_maps,
    brightness_map,
    contrast_map,
    edge_map,
    gradient_map,
)


def _ramp():
    """Brightness 2 per column and 1 per row."""
    return (2 * np.arange(60)[None] + np.arange(40)[:, None]).astype(np.uint8)[None]


def test_gradients_of_a_ramp():
    inner = (0, slice(12, -12), slice(12, -12))
    slope = np.hypot(2, 1) / 255
    # The Sobel kernel is 8 times the derivative.
    np.testing.assert_allclose(edge_map(_ramp())[inner], 8 * slope, rtol=1e-4)
    np.testing.assert_allclose(gradient_map(_ramp())[inner], 8 * slope, rtol=1e-2)
    assert brightness_map(_ramp())[0, 3, 5] == pytest.approx(13 / 255)


def test_edges_and_contrast_agree_with_scipy():
    images = np.random.default_rng(0).integers(0, 256, (2, 30, 34), np.uint8)
    values = images[1].astype(np.float64) / 255
    sobel = np.hypot(ndimage.sobel(values, 0), ndimage.sobel(values, 1))
    deviation = ndimage.generic_filter(values, np.std, 9)
    inner = (slice(5, -5), slice(5, -5))
    np.testing.assert_allclose(edge_map(images)[1][inner], sobel[inner], rtol=1e-4)
    np.testing.assert_allclose(contrast_map(images)[1][inner], deviation[inner], rtol=1e-4)


def test_a_dark_image_has_no_edges():
    dark = np.zeros((1, 16, 16), np.uint8)
    for function in (brightness_map, edge_map, contrast_map, gradient_map):
        assert function(dark).dtype == np.float32 and not function(dark).any()


def test_baselines_have_the_resolution_of_their_stage():
    images = np.random.default_rng(1).integers(0, 256, (2, 64, 64), np.uint8)
    maps = baseline_maps(images)
    assert len(maps) == 15 and all(found.shape == (2, 64, 64) for found in maps.values())
    cells = (images[0] / 255).reshape(16, 4, 16, 4).mean((1, 3))
    # Bilinear enlargement by 4 keeps the mean of four pixels around a cell's centre at inner cells nearly.
    small = maps["brightness/stage_2"][0]
    between = (small[1:-1:4, 1:-1:4] + small[2::4, 2::4]) / 2
    assert np.corrcoef(between.ravel(), cells.ravel())[0, 1] > 0.95
    deviations = [float(maps[f"brightness/stage_{k}"].std()) for k in range(1, 6)]
    assert deviations == sorted(deviations, reverse=True)
    # Images twice as wide as the network's input: a stage's cells have twice as many pixels.
    np.testing.assert_array_equal(baseline_maps(images, 2.0)["edge/stage_2"], maps["edge/stage_3"])
