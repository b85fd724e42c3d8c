import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.trajectories import fly
from perilune_render.flight.view import reach_m, view_envelope
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid, lines_in
from perilune_render.terrain.interpolation import value_at
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera

CAMERA = Camera.from_field_of_view(256, 256, 50.0)
FLIGHT = FlightConfig(azimuth_deg={"low": 0.0, "high": 360.0}, attitude_sigma_deg=1.0)
VIEW = view_envelope(CAMERA, FLIGHT)
RINGED = Grid(8, np.array([4.0, 4.5, 5.2, 6.0, 7.5, 9.0]))


def test_the_terrain_reaches_everywhere_the_camera_sees():
    half = graded_grid(config_with().terrain, VIEW).extent_m / 2
    corners = np.array([[0, 0], [256, 0], [0, 256], [256, 256]])
    for seed in range(40):
        flight = fly(FLIGHT, 40, seed)
        rays = np.einsum("nji,kj->nki", flight.rotation_camera_from_site, CAMERA.rays(corners))
        ground = flight.position_m[:, None] + rays * (flight.position_m[:, None, 2:] + 40) / -rays[..., 2:]
        assert np.abs(ground[..., :2]).max() < half


def test_spacing_is_at_most_half_the_smallest_pixel_from_which_a_place_is_seen():
    grid = graded_grid(config_with().terrain, VIEW)
    assert (np.diff(grid.half_widths_m) > 0).all() and 4_000_000 < grid.n_vertices < 6_000_000
    for altitude in np.linspace(200, 1500, 27):
        lowest = altitude - 3 * FLIGHT.position_sigma_m
        seen = grid.half_widths_m <= max(reach_m(CAMERA, FLIGHT, np.array(altitude)), grid.half_widths_m[0])
        assert grid.spacings_m[seen].max() <= 0.505 * lowest / CAMERA.fx_px


def test_a_users_own_views_set_extent_and_spacing():
    """Hovering at 60 m within 100 m of the site, never above 500 m, which shows 400 m: no flight is needed."""
    view = ViewEnvelope(np.array([60.0, 500.0]), np.array([100.0, 400.0]), 300.0)
    grid = graded_grid(config_with().terrain, view)
    assert grid.extent_m == pytest.approx(800)
    assert grid.spacing_at(99.0) <= 0.5 * 60 / 300 * 1.02 and 0.5 < grid.spacing_at(399.0) / (0.5 * 500 / 300) <= 1.01


@pytest.mark.parametrize(
    ("height_m", "reach_m"), [((), ()), ((0.0, 1.0), (1.0, 2.0)), ((2.0, 1.0), (1.0, 2.0)), ((1.0, 2.0), (1.0, np.inf))]
)
def test_views_that_are_none_are_refused(height_m, reach_m):
    with pytest.raises(ValueError, match="positive and ascending"):
        ViewEnvelope(np.array(height_m), np.array(reach_m), 300.0)


def test_a_view_of_the_horizon_is_refused():
    with pytest.raises(UserError, match=r"dataset.camera: got frames reach 8[0-9] degrees from straight down"):
        view_envelope(Camera.from_field_of_view(64, 64, 120.0), FlightConfig(attitude_sigma_deg=8.0))


def test_the_mesh_is_watertight_and_looks_up():
    faces = RINGED.quads()
    x, y = RINGED.vertices_xy()
    assert len(x) == RINGED.n_vertices == faces.max() + 1
    edges = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    # Every edge is used once in each direction, but for the outer boundary's.
    forward = {tuple(e) for e in edges.tolist()}
    assert len(forward) == len(edges)
    outer = [e for e in forward if e[::-1] not in forward]
    assert len(outer) == 8 * 8 and all(max(abs(x[a]), abs(y[a])) == 9.0 for a, _ in outer)
    px, py = x[faces], y[faces]
    area = 0.5 * (px * np.roll(py, -1, axis=1) - np.roll(px, -1, axis=1) * py).sum(axis=1)
    assert (area > 0).all() and np.isclose(area.sum(), 18.0**2)


@pytest.mark.parametrize("grid", [RINGED, Grid.even(3.0, 6)])
def test_lines_find_exactly_the_vertices_of_a_window(grid):
    x, y = grid.vertices_xy()
    lines = np.empty((2 * grid.n_half + 1 + 4 * len(grid.half_widths_m), 7))
    rng = np.random.default_rng(1)
    for _ in range(200):
        (x0, x1), (y0, y1) = np.sort(rng.uniform(-10, 10, (2, 2)), axis=1)
        found = []
        for row in lines[: lines_in((x0, x1, y0, y1), grid.n_half, grid.half_widths_m, lines)]:
            k = np.arange(int(row[5]))
            index = int(row[4]) + k
            assert np.allclose(x[index], row[0] + k * row[2]) and np.allclose(y[index], row[1] + k * row[3])
            half = np.maximum(np.abs(x[index]), np.abs(y[index])).max()
            assert row[6] == 0 or np.isclose(half, grid.half_widths_m[int(row[6])])
            found += index.tolist()
        inside = np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
        assert len(found) == len(set(found)) and sorted(found) == inside.tolist()


def test_values_between_vertices_are_those_of_a_plane():
    x, y = RINGED.vertices_xy()
    places = np.random.default_rng(2).uniform(-9, 9, (2, 3000))
    assert np.allclose(value_at(2 + 0.3 * x - 0.7 * y, RINGED, *places), 2 + 0.3 * places[0] - 0.7 * places[1])
    assert np.allclose(value_at(x, RINGED, x, y), x)
    assert value_at(x, RINGED, np.array([50.0]), np.array([3.0]))[0] == pytest.approx(9.0)


def test_half_width_for_is_where_the_spacing_is_reached():
    grid = graded_grid(config_with().terrain, VIEW)
    half = grid.half_width_for(2.0)
    assert grid.spacing_at(half - 5) <= 2.0 <= grid.spacing_at(half + 20)
    assert grid.half_width_for(0.01) == 0
