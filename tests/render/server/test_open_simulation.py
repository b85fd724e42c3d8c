"""The ground of a server: made for the stated views, or for the descents of the preset."""

import numpy as np
import pytest
from tests.helpers.scenes import config_with
from tests.render.poses.test_horizon import SMOOTH, level_view

from perilune_render.config.dataset import CameraConfig, RenderConfig
from perilune_render.config.scene import SceneConfig
from perilune_render.flight.lens import camera_of
from perilune_render.flight.view import view_envelope
from perilune_render.server.simulation import View, open_simulation
from perilune_render.terrain.grid import graded_grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import sun_direction

LOW = {"start_altitude_m": 60.0, "end_altitude_m": 30.0, "downrange_m": 20.0, "position_sigma_m": 1.0}


def config_of(scene, **changes):
    """A scene under low descents, and a small camera."""
    made = config_with(
        scene=scene,
        terrain=SMOOTH,
        camera=CameraConfig(width_px=64, height_px=48, horizontal_fov_deg=50),
        render=RenderConfig(engine="heightfield", samples=1, threads=1, cache_gib=0),
    )
    flight = made.nav.flight.model_copy(update=LOW | changes)
    return made.model_copy(update={"nav": made.nav.model_copy(update={"flight": flight})})


def view_of(config, height_m, below_deg):
    return View(np.array([0, 0, height_m]), level_view(below_deg), camera_of(config.camera), sun_direction(90, 30))


def test_a_horizon_without_views_shows_the_sky_to_the_descents_of_the_preset():
    config = config_of(SceneConfig(horizon=True))
    with open_simulation(config) as simulated:
        assert simulated.scene.view.horizon
        depth_m = simulated.frame(view_of(config, 60.0, 5.0), 0, 0).radiance.depth_m
        with pytest.raises(UserError, match="beyond the terrain's edge"):
            simulated.frame(view_of(config, 5000.0, 5.0), 0, 0)
    assert 0.2 < np.isinf(depth_m).mean() < 0.8


def test_a_horizon_of_too_high_descents_is_refused():
    config = config_of(SceneConfig(horizon=True), start_altitude_m=30_000.0)
    with pytest.raises(UserError, match=r"dataset.scene.views: got none"):
        open_simulation(config)


def test_the_ground_fits_the_descents_of_a_kind():
    """`detect` starts farther from the site than `nav` here."""
    config = config_of(None)
    detect = config.detect.model_copy(update={"flight": config.nav.flight.model_copy(update={"downrange_m": 90.0})})
    config = config.model_copy(update={"detect": detect})
    for kind in ("detect", "nav"):
        view = view_envelope(camera_of(config.camera), config.kind(kind).flight)
        with open_simulation(config, kind) as simulated:
            assert simulated.scene.grid.extent_m == graded_grid(config.terrain, view).extent_m
    with open_simulation(config) as plain, open_simulation(config, "detect") as wider:
        assert wider.scene.grid.extent_m > plain.scene.grid.extent_m + 50


def test_blender_refuses_a_ground_of_which_it_would_show_only_one_descent():
    pytest.importorskip("bpy")
    config = config_of(None)
    config = config.model_copy(update={"render": config.render.model_copy(update={"engine": "cycles"})})
    whole = graded_grid(config.terrain, view_envelope(camera_of(config.camera), config.nav.flight)).n_vertices
    limited = config.terrain.model_copy(update={"max_vertices": whole - 1})
    with pytest.raises(UserError, match=r"dataset.terrain.spacing_px: got 2.0 needs .* vertices"):
        open_simulation(config.model_copy(update={"terrain": limited}))
    just = config.terrain.model_copy(update={"max_vertices": whole})
    with open_simulation(config.model_copy(update={"terrain": just})) as simulated:
        assert simulated.scene.view.seen is None and simulated.scene.grid.n_vertices == whole
