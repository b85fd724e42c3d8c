import numpy as np
from tests.helpers.scenes import config_with, round_craters

from perilune_render.flight.view import view_envelope
from perilune_render.terrain.albedo import RayLaw, add_patches, add_rays, brightness
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import grow_scene

GRID = Grid.even(300, 300)


def ring(albedo, radius_m, n=720):
    angle = 2 * np.pi * np.arange(n) / n
    return value_at(albedo, GRID, radius_m * np.cos(angle), radius_m * np.sin(angle))


def test_fresh_craters_are_bright_and_darken_as_they_wear():
    bright = brightness(round_craters([(0, 0, 40, 0.15, wear) for wear in (1e-4, 1e-3, 5e-3, 0.02, 0.1)]))
    assert bright[0] > 0.4 and (np.diff(bright) < 0).all() and bright[-1] < 1e-6


def test_rays_run_outwards_from_the_largest_fresh_crater_and_end():
    craters = round_craters([(0, 0, 50, 0.15, 1e-4), (200, 200, 20, 0.15, 1e-4), (-200, 0, 80, 0.15, 0.05)])
    albedo = np.ones(GRID.n_vertices)
    add_rays(albedo, GRID, craters, RayLaw(1, 1.0), 3)
    near = ring(albedo, 60.0)
    # Some directions are bright, others untouched; beyond nine radii nothing is.
    assert near.max() > 1.1 and (near < 1.01).mean() > 0.2 and ring(albedo, 229.0).max() == 1
    assert value_at(albedo, GRID, -130.0, 0.0) < 1.2 and value_at(albedo, GRID, 200.0, 215.0) == 1
    again = np.ones(GRID.n_vertices)
    add_rays(again, GRID, craters, RayLaw(1, 1.0), 3)
    assert np.array_equal(albedo, again)
    add_rays(again, GRID, craters, RayLaw(0, 1.0), 3)
    assert np.array_equal(albedo, again)


def test_patches_vary_with_place_about_one():
    albedo = np.ones(GRID.n_vertices)
    add_patches(albedo, GRID, 1.0, 5)
    assert 0.02 < albedo.std() < 0.2 and abs(albedo.mean() - 1) < 0.05


def test_without_variation_the_ground_is_even(camera):
    config = config_with(light={"albedo_variation": 0.0}, terrain={"spacing_px": 2.0})
    assert (grow_scene(config, view_envelope(camera, config.detect.flight), 1).albedo == 1).all()
