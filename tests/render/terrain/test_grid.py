import numpy as np

from perilune_render.config import FlightConfig
from perilune_render.flight import fly
from perilune_render.terrain.grid import graded_grid, reach_m
from perilune_shared.camera import Camera
from tests.render.conftest import config_with

CAMERA = Camera.from_field_of_view(256, 256, 50.0)
FLIGHT = FlightConfig(azimuth_deg={"low": 0.0, "high": 360.0}, attitude_sigma_deg=1.0)


def test_the_terrain_reaches_everywhere_the_camera_sees():
    half = graded_grid(config_with(), CAMERA, FLIGHT).extent_m / 2
    corners = np.array([[0, 0], [256, 0], [0, 256], [256, 256]])
    for seed in range(20):
        flight = fly(FLIGHT, 40, seed)
        rays = np.einsum("nji,kj->nki", flight.rotation_camera_from_site, CAMERA.rays(corners))
        ground = flight.position_m[:, None] + rays * (flight.position_m[:, None, 2:] + 60) / -rays[..., 2:]
        assert np.abs(ground[..., :2]).max() < half


def test_spacing_follows_the_smallest_pixel_from_which_a_place_is_seen():
    config = config_with()
    grid = graded_grid(config, CAMERA, FLIGHT)
    steps = np.diff(grid.coordinates_m)
    assert 1_500_000 < len(grid.coordinates_m) ** 2 <= config.terrain.max_vertices
    assert np.allclose(grid.coordinates_m, -grid.coordinates_m[::-1]) and (steps > 0).all()
    for altitude in (200.0, 400.0, 800.0):
        seen = reach_m(CAMERA, FLIGHT, np.array(altitude))
        assert grid.spacing_at(seen) < 1.0 * altitude / CAMERA.fx_px


def test_half_width_for_is_where_the_spacing_is_reached():
    grid = graded_grid(config_with(), CAMERA, FLIGHT)
    half = grid.half_width_for(2.0)
    assert grid.spacing_at(np.array(half - 5)) <= 2.0 <= grid.spacing_at(np.array(half + 20))
    assert grid.half_width_for(0.01) == 0


def test_no_more_vertices_than_allowed():
    config = config_with(terrain={"max_vertices": 250_000})
    assert len(graded_grid(config, CAMERA, FLIGHT).coordinates_m) ** 2 <= 250_000
