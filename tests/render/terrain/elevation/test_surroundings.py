import dataclasses

import numpy as np
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import config_with

from perilune_render.config.terrain import CratersConfig, ReliefConfig
from perilune_render.flight.view import view_envelope
from perilune_render.terrain.craters.population import draw_craters
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.elevation.model import base_heights, read_elevation, remarks, resolved_m
from perilune_render.terrain.elevation.surroundings import add_fitted_relief, fitted_relief, second_differences
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.relief import add_relief
from perilune_render.terrain.scene import base_of, check_ground, grow_scene
from perilune_shared.errors import UserError

PIXEL_M = 4.0
N = 129
GRID = Grid.even(900, 225)
NO_CRATERS = CratersConfig(max_diameter_m=0.1)


def model_of(path, height, pixel_m=PIXEL_M):
    return read_elevation(write(path, height, POLAR, rasterio.Affine(pixel_m, 0, 1e5, 0, -pixel_m, 0)))


@pytest.fixture
def pit(tmp_path):
    """516 m of gentle ground with one pit 60 m deep and 120 m wide, 100 m from the edge."""
    y, x = np.mgrid[:N, :N] * PIXEL_M
    rough = np.zeros(Grid.even(256, 64).n_vertices)
    add_relief(rough, Grid.even(256, 64), ReliefConfig(), 3, 0.0, np.inf)
    bowl = np.clip(1 - ((x - 350) ** 2 + (y - 160) ** 2) / 60**2, 0, None)
    return model_of(tmp_path / "pit.tif", rough.reshape(N, N) - 60 * bowl)


def test_nothing_of_the_model_is_repeated_beyond_its_edge(pit):
    mirrored, beyond = base_heights(pit, GRID, "mirror")
    assert (mirrored[beyond > 20] < -30).sum() > 100
    ours, again = base_heights(pit, GRID)
    assert np.array_equal(beyond, again) and ours[beyond > 20].min() > -12
    assert ours[beyond == 0].min() < -50


def test_level_and_slope_go_on_across_the_edge(tmp_path):
    # A slope that rises across the edge continues at first; a mirror image would fold it.
    height = np.tile(np.arange(200.0), (200, 1)) + np.random.default_rng(1).normal(0, 0.2, (200, 200))
    base, beyond = base_heights(model_of(tmp_path / "a.tif", height, 5.0), Grid.even(800, 160))
    beyond = beyond.reshape(321, 321)
    gy, gx = np.gradient(base.reshape(321, 321), 5.0)
    slope = np.stack([gx, gy])
    inside, near, far = (
        np.median(slope[:, which], axis=1) for which in (beyond == 0, (beyond > 0) & (beyond < 60), beyond > 250)
    )
    assert np.linalg.norm(inside) > 0.15 and np.allclose(inside, near, atol=0.02)
    # Far from the edge it levels out.
    assert np.linalg.norm(far) < 0.7 * np.linalg.norm(inside)
    second = np.abs(np.diff(base.reshape(321, 321), 2, axis=0))[:, 20:-20]
    edge = (beyond[1:-1, 20:-20] > 0) & (beyond[1:-1, 20:-20] < 10)
    assert np.median(second[edge]) < 2 * np.median(second[beyond[1:-1, 20:-20] == 0])


def test_real_heights_are_kept_exactly_beside_the_craters_outside(pit):
    config = config_with().terrain
    base = base_of(pit, GRID, config, 1)
    before = base.height_m.copy()
    base.add_waves(GRID, ReliefConfig(rms_slope_deg={"low": 0.0, "high": 0.0}), 1, 0.0, np.inf)
    drawn = draw_craters(config.craters, GRID, 1, base.largest_m)
    laid = base.permitted(drawn)
    large = laid.chosen(laid.diameter_m > resolved_m(pit))
    assert len(large) > 50 and len(laid) < len(drawn)
    stamp_craters(base.height_m, np.ones(GRID.n_vertices), GRID, large, np.zeros(len(large)))
    inside = base.beyond_m == 0
    assert inside.sum() > 10_000 and np.array_equal(base.height_m[inside], before[inside])
    assert not np.allclose(base.height_m[~inside], before[~inside], atol=0.5)


def test_relief_outside_has_the_roughness_of_the_model(tmp_path):
    own = Grid.even(500, 100)
    for slope, hurst in ((3.0, 0.9), (8.0, 0.7)):
        height = np.zeros(own.n_vertices)
        relief = ReliefConfig(rms_slope_deg={"low": slope, "high": slope}, hurst_exponent=hurst)
        add_relief(height, own, relief, 5, 0.0, np.inf)
        model = model_of(tmp_path / "a.tif", height.reshape(201, 201), 5.0)
        fitted = fitted_relief(model, ReliefConfig(), NO_CRATERS, 1)
        assert fitted.hurst_exponent == pytest.approx(hurst, abs=0.15)
        around = np.zeros(own.n_vertices)
        add_fitted_relief(around, own, fitted, np.full(own.n_vertices, 1e4), 1, (0.0, np.inf))
        baselines = np.array([8, 16, 32])
        found = second_differences(around.reshape(201, 201), baselines)
        assert np.allclose(found / second_differences(model.height_m, baselines), 1, atol=0.35)


def test_relief_is_left_out_where_craters_make_the_roughness(pit):
    alone, beside = (fitted_relief(pit, ReliefConfig(), craters, 1) for craters in (NO_CRATERS, CratersConfig()))
    assert beside.amplitude_m[-1] < 0.8 * alone.amplitude_m[-1]


def test_flat_ground_gets_no_relief(tmp_path):
    assert not fitted_relief(
        model_of(tmp_path / "a.tif", np.full((60, 60), 7.0)), ReliefConfig(), NO_CRATERS, 1
    ).amplitude_m.any()


def test_a_scene_says_what_is_real_and_has_large_craters_outside(pit, tmp_path, camera):
    config = config_with(terrain={"dem": str(tmp_path / "pit.tif"), "spacing_px": 1.0, "boulders": {"density": 0.0}})
    scene = grow_scene(config, view_envelope(camera, config.detect.flight), 1)
    x, y = scene.grid.vertices_xy()
    # The raster is turned against the site's axes, since the site is not on its central meridian.
    half = np.hypot(x, y)
    assert scene.real[half < 255].all() and not scene.real[half > 366].any()
    large = scene.craters.diameter_m > 1.01 * resolved_m(pit)
    far = np.maximum(np.abs(scene.craters.x_m), np.abs(scene.craters.y_m)) > 250
    assert large.sum() > 50 and far[large].all()


def test_ground_beyond_the_model_can_be_refused(pit, tmp_path, camera):
    with pytest.raises(UserError, match=r"a model of 51[0-9] m x 51[0-9] m for 1800 m of ground"):
        base_heights(pit, GRID, "refuse")
    base_heights(pit, Grid.even(200, 50), "refuse")
    terrain = {"dem": str(tmp_path / "pit.tif"), "spacing_px": 1.0, "elevation": {"outside": "refuse"}}
    config = config_with(terrain=terrain)
    with pytest.raises(UserError, match=r"dataset\.terrain\.elevation\.outside"):
        check_ground(config, view_envelope(camera, config.detect.flight))


def test_what_is_real_is_said_before_the_work_begins(pit, tmp_path, camera, capsys):
    stepped = model_of(tmp_path / "steps.tif", np.rint(pit.height_m))
    lines = remarks(stepped, GRID, "procedural")
    assert "steps of 1 m" in lines[0] and "8% of the ground, 1800 m x 1800 m, is real, the rest procedural" in lines[1]
    assert remarks(pit, Grid.even(150, 30), "procedural") == []
    config = config_with(terrain={"dem": str(tmp_path / "pit.tif"), "spacing_px": 1.0})
    check_ground(config, view_envelope(camera, config.detect.flight))
    assert "is real, the rest procedural" in capsys.readouterr().err


def test_holes_are_smooth_and_not_real(pit):
    known = pit.known.copy()
    known[20:50, 20:50] = False
    height = pit.height_m.copy()
    holed = dataclasses.replace(pit, known=known, height_m=height, hole_m=np.where(known, 0.0, 8.0))
    base, beyond = base_heights(holed, Grid.even(200, 50))
    assert (beyond > 0).sum() > 500 and np.isfinite(base).all()
