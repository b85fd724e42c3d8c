import numpy as np

from perilune_render.config import BouldersConfig, CratersConfig
from perilune_render.terrain.boulders import draw_boulders, rock
from perilune_render.terrain.craters import draw_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.size_frequency import BoulderLaw

GRID = Grid(np.linspace(-500, 500, 2001))


def test_rocks_are_closed_convex_and_of_mean_diameter_one():
    for shape_id in range(6):
        mesh = rock(shape_id, 3)
        assert mesh.is_watertight and mesh.is_convex and mesh.volume > 0.2
        assert np.isclose(mesh.extents.mean(), 1)
    assert not np.array_equal(rock(0, 3).vertices, rock(1, 3).vertices)
    assert np.array_equal(rock(2, 3).vertices, rock(2, 3).vertices)


def test_numbers_follow_the_law():
    craters = draw_craters(CratersConfig(), GRID, 2)
    boulders = draw_boulders(BouldersConfig(), GRID, craters, 2)
    for diameter in (0.75, 1.0, 1.5):
        expected = (BoulderLaw().csfd(diameter) - BoulderLaw().csfd(5.0)) * 1e6
        assert abs((boulders.diameter_m >= diameter).sum() - expected) < 4 * np.sqrt(expected)
    assert np.allclose(np.linalg.norm(boulders.rotation_wxyz, axis=1), 1)


def test_boulders_crowd_around_young_craters():
    craters = draw_craters(CratersConfig(), GRID, 2)
    even = draw_boulders(BouldersConfig(clustered_share=0.0), GRID, craters, 2)
    clustered = draw_boulders(BouldersConfig(clustered_share=1.0), GRID, craters, 2)
    young = (craters.diameter_m > 30) & (craters.wear_m2 < 0.01 * (craters.diameter_m / 2) ** 2)

    def near(boulders):
        distance = np.hypot(boulders.x_m[:, None] - craters.x_m[young], boulders.y_m[:, None] - craters.y_m[young])
        return (distance < craters.diameter_m[young]).any(axis=1).mean()

    assert near(clustered) > 2 * near(even)


def test_no_density_no_boulders():
    assert len(draw_boulders(BouldersConfig(density=0.0), GRID, draw_craters(CratersConfig(), GRID, 2), 2)) == 0
