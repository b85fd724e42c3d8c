"""Images of the flash lidar over flat ground: ranges, noise, dropouts and false returns as configured."""

import numpy as np
import pytest
from tests.helpers.scenes import flat_scene

from perilune_render.config.outputs import FlashLidarConfig
from perilune_render.engines.frame_source import Shot
from perilune_render.engines.heightfield.surface import surface_of
from perilune_render.imaging.exr import read_exr
from perilune_render.outputs.flash_lidar import flash, lidar_camera

DOWN = np.diag([1.0, -1.0, -1.0])
EXACT = {"range_sigma_m": 0.0, "quantisation_m": 0.0, "energy_sigma_share": 0.0}


@pytest.fixture(scope="module")
def surface():
    return surface_of(flat_scene(400.0, 41))


def shot(height_m=100.0, rotation=DOWN, seed=5, index=0):
    return Shot(np.array([0.0, 0.0, height_m]), rotation, np.zeros(3), seed, index)


def taken(surface, height_m=100.0, rotation=DOWN, seed=5, index=0, **settings):
    return flash(surface, shot(height_m, rotation, seed, index), FlashLidarConfig(**settings))


def test_true_ranges_are_those_of_the_plane(surface):
    config = FlashLidarConfig(**EXACT, width_px=32, height_px=16)
    image = flash(surface, shot(), config)
    camera = lidar_camera(config)
    expected = 100.0 * np.linalg.norm(camera.rays(camera.pixel_centres()), axis=-1)
    assert image.true_m.shape == (16, 32)
    assert np.allclose(image.true_m, expected, rtol=1e-9, atol=0)
    assert np.array_equal(image.range_m, image.true_m)
    # Albedo 1 and cos(incidence) = height / range.
    assert np.allclose(image.intensity, (100 / expected) * (config.threshold_range_m / expected) ** 2, rtol=1e-9)


def test_noise_has_the_mean_and_the_deviation_of_the_settings(surface):
    settings = {"range_sigma_m": 0.1, "range_sigma_share": 0.001, "quantisation_m": 0.0, "energy_sigma_share": 0.05}
    image = taken(surface, **settings, horizontal_fov_deg=1.0)
    error = image.range_m - image.true_m
    n = error.size
    assert abs(error.mean()) < 4 * 0.2 / np.sqrt(n)
    assert error.std() == pytest.approx(0.1 + 0.001 * 100, rel=4 / np.sqrt(2 * n))
    relative = image.intensity / (1500.0 / image.true_m) ** 2
    assert relative.mean() == pytest.approx(1, abs=1e-3)
    assert relative.std() == pytest.approx(0.05, rel=0.04)


def test_ranges_are_multiples_of_the_step(surface):
    image = taken(surface, quantisation_m=0.25)
    assert np.array_equal(image.range_m, np.round(image.range_m / 0.25) * 0.25)
    assert len(np.unique(image.range_m)) > 5


def test_weak_returns_are_lost(surface):
    """From the threshold's distance half of all returns are lost; from twice as far, all."""
    settings = {"threshold_range_m": 100.0, "horizontal_fov_deg": 0.5}
    assert np.isnan(taken(surface, 100.0, **settings).range_m).mean() == pytest.approx(0.5, abs=0.03)
    assert not np.isnan(taken(surface, 70.0, **settings).range_m).any()
    lost = taken(surface, 200.0, **settings)
    assert np.isnan(lost.range_m).all() and np.isnan(lost.intensity).all()
    assert np.isfinite(lost.true_m).all()


def test_oblique_ground_returns_less_by_the_cosine(surface):
    tilt = np.radians(40)
    c, s = np.cos(tilt), np.sin(tilt)
    turned = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ DOWN
    image = taken(surface, rotation=turned, width_px=1, height_px=1, **EXACT)
    assert image.true_m[0, 0] == pytest.approx(100 / c)
    assert image.intensity[0, 0] == pytest.approx(c * (1500 / (100 / c)) ** 2)


def test_beyond_the_largest_range_and_the_ground_there_is_no_return(surface):
    assert np.isnan(taken(surface, max_range_m=90.0).range_m).all()
    up = taken(surface, rotation=np.eye(3))
    assert np.isnan(up.range_m).all() and np.isnan(up.true_m).all()


def test_false_returns_are_spread_over_all_ranges(surface):
    image = taken(surface, rotation=np.eye(3), false_return_share=0.2, max_range_m=1000.0)
    false = np.isfinite(image.range_m)
    assert false.mean() == pytest.approx(0.2, abs=0.015)
    assert image.range_m[false].mean() == pytest.approx(500, abs=25)
    assert image.range_m[false].std() == pytest.approx(1000 / np.sqrt(12), rel=0.05)


def test_noise_depends_on_seed_and_index_alone(surface):
    first, again = taken(surface), taken(surface)
    assert first.exr() == again.exr()
    assert not np.array_equal(first.range_m, taken(surface, index=1).range_m)
    assert not np.array_equal(first.range_m, taken(surface, seed=6).range_m)


def test_the_file_has_three_channels(surface, tmp_path):
    image = taken(surface, threshold_range_m=100.0)
    (tmp_path / "flash.exr").write_bytes(image.exr())
    channels = read_exr(tmp_path / "flash.exr")
    assert sorted(channels) == ["intensity", "range", "range_true"]
    assert np.array_equal(channels["range"], image.range_m.astype(np.float32), equal_nan=True)
    assert channels["range_true"].dtype == np.float32
