import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from tests.helpers.scenes import round_craters

from perilune_render.config.terrain import BouldersConfig, CratersConfig
from perilune_render.terrain.boulders import boulder_mesh, draw_boulders, rock
from perilune_render.terrain.craters.population import draw_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.size_frequency import BoulderLaw

GRID = Grid.even(500, 1000)


def test_rocks_are_closed_convex_and_of_mean_diameter_one():
    for shape_id in range(6):
        mesh = rock(shape_id, 3)
        assert mesh.is_watertight and mesh.is_convex and mesh.volume > 0.2
        assert np.isclose(mesh.extents.mean(), 1)
    assert not np.array_equal(rock(0, 3).vertices, rock(1, 3).vertices)
    assert np.array_equal(rock(2, 3).vertices, rock(2, 3).vertices)


def test_numbers_follow_the_law():
    craters = draw_craters(CratersConfig(), GRID, 2)
    boulders = draw_boulders(BouldersConfig(density=1.0, field_density=0.0), GRID, craters, 2)
    for diameter in (0.75, 1.0, 1.5):
        expected = (BoulderLaw().csfd(diameter) - BoulderLaw().csfd(5.0)) * 1e6
        assert abs((boulders.diameter_m >= diameter).sum() - expected) < 4 * np.sqrt(expected)
    assert np.allclose(np.linalg.norm(boulders.rotation_wxyz, axis=1), 1)


def test_boulders_crowd_around_young_craters():
    craters = draw_craters(CratersConfig(), GRID, 2)
    even = draw_boulders(BouldersConfig(density=1.0, field_density=0.0), GRID, craters, 2)
    clustered = draw_boulders(BouldersConfig(density=1.0, field_density=50.0), GRID, craters, 2)
    young = (craters.diameter_m > 30) & (craters.wear_m2 < 0.01 * (craters.diameter_m / 2) ** 2)

    def near(boulders):
        distance = np.hypot(boulders.x_m[:, None] - craters.x_m[young], boulders.y_m[:, None] - craters.y_m[young])
        return (distance < craters.diameter_m[young]).any(axis=1).mean()

    assert near(clustered) > 1.5 * near(even)


def test_fields_thin_out_with_distance():
    crater = round_craters([(0, 0, 200, 0.2)])
    config = BouldersConfig(density=0.01, field_density=10_000.0)
    boulders = draw_boulders(config, GRID, crater, 2)
    x = np.hypot(boulders.x_m, boulders.y_m) / 100
    # Density at the rim is the asked multiple of the plain's, and e times less 0.7 radii further out.
    plain = BoulderLaw(density=0.01).csfd(0.35) - BoulderLaw(density=0.01).csfd(5.0)
    for low, expected in ((1.0, 10_000 * plain), (1.7, 10_000 * plain / np.e)):
        ring = (x > low) & (x < low + 0.02)
        area = np.pi * 100**2 * ((low + 0.02) ** 2 - low**2)
        assert ring.sum() / area / expected == pytest.approx(0.985, abs=4 / np.sqrt(ring.sum()))
    assert (boulders.diameter_m <= 5).all()


def test_one_mesh_holds_every_boulder_where_it_lies():
    boulders = draw_boulders(
        BouldersConfig(density=1.0, field_density=0.0), GRID, draw_craters(CratersConfig(), GRID, 2), 2
    )
    z = boulders.centre_height_m(np.full(len(boulders), 7.0))
    vertices, faces = boulder_mesh(boulders, z, GRID, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    parts = mesh.split(only_watertight=True)
    assert len(parts) == len(boulders) and mesh.is_watertight
    centres = np.array([part.bounds.mean(axis=0) for part in parts])
    nearest = KDTree(np.stack([boulders.x_m, boulders.y_m], axis=1)).query(centres[:, :2])[1]
    off = np.linalg.norm(centres - np.stack([boulders.x_m, boulders.y_m, z], axis=1)[nearest], axis=1)
    assert (off < 0.5 * boulders.diameter_m[nearest]).all() and len(set(nearest)) > 0.99 * len(boulders)


def test_no_density_no_boulders():
    assert len(draw_boulders(BouldersConfig(density=0.0), GRID, draw_craters(CratersConfig(), GRID, 2), 2)) == 0
