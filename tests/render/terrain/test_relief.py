import numpy as np
import pytest

from perilune_render.config.terrain import ReliefConfig
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.noise import RMS_SLOPE, add_waves
from perilune_render.terrain.relief import add_relief

GRID = Grid.even(512, 512)
FIVE = {"low": 5.0, "high": 5.0}


def slope_rms(height, step):
    gy, gx = np.gradient(height.reshape(1025, 1025), step)
    return np.sqrt((gx**2 + gy**2).mean())


def test_noise_has_the_stated_slope():
    field = np.zeros(GRID.n_vertices)
    add_waves(field, GRID, 40.0, 1.0, np.random.default_rng(7))
    assert abs(slope_rms(field, 1.0) * 40 / RMS_SLOPE - 1) < 0.05
    assert abs(field.mean()) < 0.05


def test_noise_fades_where_the_grid_cannot_hold_it():
    field = np.zeros(GRID.n_vertices)
    add_waves(field, GRID, 2.0, 1.0, np.random.default_rng(7))
    assert not field.any()


def test_relief_has_the_asked_slope_and_is_seeded():
    fields = [np.zeros(GRID.n_vertices) for _ in range(3)]
    for field, seed in zip(fields, (1, 1, 2), strict=True):
        add_relief(
            field,
            GRID,
            ReliefConfig(rms_slope_deg=FIVE, longest_wavelength_m=256.0),
            seed,
            0.0,
            np.inf,
        )
    assert np.array_equal(fields[0], fields[1]) and not np.array_equal(fields[0], fields[2])
    # The two octaves below 3 m that the grid cannot hold carry about a quarter of the variance.
    assert 3.5 < np.degrees(np.arctan(slope_rms(fields[0], 1.0))) < 5.5


def test_relief_is_self_affine():
    height = np.zeros(GRID.n_vertices)
    add_relief(height, GRID, ReliefConfig(hurst_exponent=0.8, longest_wavelength_m=512.0), 3, 0.0, np.inf)
    height = height.reshape(1025, 1025)
    lags = np.array([8, 16, 32, 64])
    deviations = [np.sqrt(np.mean((height[:, lag:] - height[:, :-lag]) ** 2)) for lag in lags]
    assert abs(np.polyfit(np.log(lags), np.log(deviations), 1)[0] - 0.8) < 0.1


def test_slopes_are_spread_as_a_normal_law():
    height = np.zeros(GRID.n_vertices)
    for seed in (3, 4, 5):
        add_relief(height, GRID, ReliefConfig(rms_slope_deg=FIVE, longest_wavelength_m=128.0), seed, 0.0, np.inf)
    slope = np.diff(height.reshape(1025, 1025), axis=1).ravel()
    slope = (slope - slope.mean()) / slope.std()
    # Shares within one, two and three standard deviations: 0.683, 0.954, 0.997.
    shares = [np.mean(np.abs(slope) < k) for k in (1, 2, 3)]
    assert shares[0] == pytest.approx(0.683, abs=0.02) and shares[1] == pytest.approx(0.954, abs=0.01)
    assert shares[2] == pytest.approx(0.997, abs=0.003)
