"""Rays over the height field hit what Embree hits on the same triangles; the engine sees what Blender sees."""

import numpy as np
import pytest
from tests.helpers.scenes import config_with, flat_scene, round_craters

from benchmarks.scene.truth import CAMERA, POSES, RAYS, Caster, pose
from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.beam import begin_m, only_part, tops_of
from perilune_render.engines.heightfield.engine import HeightfieldEngine, rays_of
from perilune_render.engines.heightfield.horizon import NOWHERE, horizon_of
from perilune_render.engines.heightfield.query import first_hits
from perilune_render.flight.view import view_envelope
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.poses.plan import scene_seed
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.photometry import radiance_factor

SUN = sun_direction(60, 30)


def settings(**render):
    terrain = TerrainConfig(spacing_px=1.0, boulders=BouldersConfig(density=10.0))
    return config_with(terrain=terrain, render=RenderConfig(**{"samples": 2, "threads": 2} | render))


@pytest.fixture(scope="module")
def scene():
    """Ground with rings, craters and many boulders."""
    config = settings()
    return grow_scene(config, view_envelope(CAMERA, config.detect.flight), 3)


@pytest.fixture(scope="module")
def engine(scene):
    with HeightfieldEngine(scene, settings(), CAMERA, SUN, 2) as engine:
        yield engine


@pytest.fixture(scope="module")
def caster(scene):
    return Caster(scene)


def cast(engine, origins, directions):
    return first_hits(engine.surface, origins, directions)[0]


def places(scene):
    """The poses of the benchmark of truth, and cameras close to the ground, off the site, that look at the horizon."""
    found = [pose(scene, *place) for place in POSES]
    steep = [(30.0, 70.0, 0.0), (30.0, 80.0, 135.0), (5.0, 75.0, 225.0)]
    return found + [pose(scene, *place) for place in steep]


def test_rays_hit_what_embree_hits(scene, engine, caster):
    n_rock = n_sky = 0
    for position, rotation in places(scene):
        expected = caster.cast(position, RAYS @ rotation)
        radiance = engine.render(position, rotation)
        depth, normal = radiance.depth_m.ravel(), radiance.normal.reshape(-1, 3)
        both = np.isfinite(depth) & np.isfinite(expected.depth)
        assert (np.isfinite(depth) == np.isfinite(expected.depth)).mean() >= 0.9995
        close = np.abs(depth[both] / expected.depth[both] - 1) < 1e-5
        assert close.mean() >= 0.999
        assert (np.linalg.norm(normal[both][close] - expected.normal[both][close], axis=1) < 1e-3).mean() >= 0.999
        n_rock += int(expected.rock.sum())
        n_sky += int(np.isinf(expected.depth).sum())
    assert n_rock > 1000
    assert n_sky > 1000


def test_shadow_rays_hit_what_embree_hits(scene, engine, caster):
    """From points above the ground all over the mesh, towards low Suns in all directions."""
    rng = np.random.default_rng(1)
    half = scene.grid.half_widths_m[-1]
    x, y = rng.uniform(-0.95, 0.95, (2, 4000)) * half * rng.uniform(0, 1, 4000) ** 2
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    start = np.stack([x, y, np.full(len(x), 500.0)], axis=1)
    first = cast(engine, start, down)
    ground = start + down * first[:, None]
    assert np.isfinite(first).all()
    for azimuth in (10, 100, 190, 300):
        towards = np.tile(sun_direction(azimuth, 6.0), (len(x), 1))
        origin = ground + np.array([0, 0, 0.05])
        found = np.isfinite(cast(engine, origin, towards))
        expected = caster.engine.intersects_any(origin, towards)
        assert 0.02 < expected.mean() < 0.98
        assert (found == expected).mean() > 0.999


def test_a_ray_along_the_lines_of_the_mesh_is_not_lost():
    """Straight down onto vertices and diagonals, and along the axes and diagonals of the grid."""
    config = settings()
    flat = grow_scene(config, view_envelope(CAMERA, config.detect.flight), 4)
    with HeightfieldEngine(flat, config, CAMERA, SUN, 1) as engine:
        x, y = flat.grid.vertices_xy()
        chosen = np.linspace(0, len(x) - 1, 5000).astype(int)
        inside = chosen[np.maximum(np.abs(x), np.abs(y))[chosen] < 0.999 * flat.grid.half_widths_m[-1]]
        start = np.stack([x[inside], y[inside], np.full(len(inside), 900.0)], axis=1)
        depth = cast(engine, start, np.tile([0.0, 0.0, -1.0], (len(inside), 1)))
        above_m = 900 - depth - flat.height_m[inside]
        assert (above_m > -1e-4).all()  # also not infinite
        assert (above_m < 1e-4).mean() > 0.97  # the others are on boulders
        slanted = [(a, b, -0.5) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        assert np.isfinite(cast(engine, np.tile([0.0, 0.0, 300.0], (9, 1)), np.array(slanted, float))).all()


def test_flat_ground_has_the_radiance_of_the_formula():
    plain = flat_scene(400.0, 81)
    config = config_with(light=LightConfig(photometry="hapke_mean", albedo_variation=0.0, sun_angular_diameter_deg=0.0))
    rotation = np.diag([1.0, -1.0, -1.0])
    with HeightfieldEngine(plain, config, CAMERA, SUN, 1) as engine:
        radiance = engine.render(np.array([0.0, 0.0, 100.0]), rotation)
    rays = (CAMERA.rays(CAMERA.pixel_centres()) @ rotation).reshape(-1, 3)
    view = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    expected = radiance_factor("hapke_mean", np.full(len(view), SUN[2]), view[:, 2], view @ SUN)
    # The other samples of a pixel are beside its centre.
    assert np.allclose(radiance.radiance_factor.ravel(), expected, rtol=0.01, atol=0)
    assert radiance.sunlit.all()


def test_a_crater_has_a_shadow_on_the_side_of_the_sun():
    config = config_with(render=RenderConfig(samples=1))
    n = 201
    axis = np.linspace(-100, 100, n)
    x, y = np.meshgrid(axis, axis)
    bowl = 12 * np.minimum((np.hypot(x, y) / 40) ** 2 - 1, 0)
    pit = flat_scene(200.0, n, round_craters([[0, 0, 80, 0.15]]), bowl)
    towards = sun_direction(90, 15)  # east, -x
    with HeightfieldEngine(pit, config, CAMERA, towards, 1) as engine:
        radiance = engine.render(np.array([0.0, 0.0, 150.0]), np.diag([1.0, -1.0, -1.0]))
    ground = 150 * (CAMERA.pixel_centres()[..., 0] - CAMERA.cx_px) / CAMERA.fx_px
    middle = CAMERA.height_px // 2
    dark = ~radiance.sunlit[middle]
    assert dark.any()
    assert ground[middle][dark].max() < 15
    assert ground[middle][dark].min() < -20
    assert radiance.sunlit[5].all()


def test_the_seed_sets_the_samples(scene, engine):
    position, rotation = pose(scene, *POSES[0])
    first, again, other = (engine.render(position, rotation, seed) for seed in (1, 1, 2))
    assert (first.radiance_factor == again.radiance_factor).all()
    assert (first.radiance_factor != other.radiance_factor).any()
    assert (first.depth_m == other.depth_m).all()


def test_the_number_of_threads_changes_no_bit(scene, engine):
    position, rotation = pose(scene, *POSES[1])
    with HeightfieldEngine(scene, settings(), CAMERA, SUN, 1) as alone:
        first, second = engine.render(position, rotation, 5), alone.render(position, rotation, 5)
    for name in ("radiance_factor", "depth_m", "normal", "sunlit"):
        assert (getattr(first, name) == getattr(second, name)).all()


def test_ground_does_not_shadow_itself_at_an_edge_of_its_triangles():
    """Rays of a camera above the site meet the mesh on the diagonals of its cells, where no shadow ray may start wrong.

    Without the horizon, the engine casts those rays; with it, it casts none.
    """
    focal_px = 32 / np.tan(np.radians(20))
    camera, sun = Camera(64, 48, focal_px, focal_px, 32.0, 24.0), sun_direction(100, 25)
    views = ViewEnvelope(np.array([150.0, 1000.0]), np.array([200.0, 500.0]), focal_px)
    config = config_with(terrain=TerrainConfig(spacing_px=2.0), render=RenderConfig(samples=1))
    with HeightfieldEngine(grow_scene(config, views, scene_seed(config)), config, camera, sun, 1) as one:
        found, horizon = [], horizon_of(one.surface.ground, sun, np.radians(0.533 / 2))
        for one.horizon in (NOWHERE, horizon):
            found.append(one.render(np.array([0.0, 0.0, 500.0]), np.diag([1.0, -1.0, -1.0]), 5).sunlit)
        assert (found[0] == found[1]).all()


@pytest.mark.slow
def test_the_horizon_changes_no_bit(scene, engine):
    """It only leaves out shadow rays that hit nothing, with most of the lit ground among them."""
    for azimuth, elevation in ((0, 8), (60, 30), (200, 15), (315, 50)):
        sun = sun_direction(azimuth, elevation)
        with HeightfieldEngine(scene, settings(), CAMERA, sun, 2, engine.surface) as one:
            horizon = horizon_of(one.surface.ground, sun, np.radians(0.533 / 2))
            for position, rotation in places(scene):
                found = []
                for one.horizon in (NOWHERE, horizon):
                    found.append(one.render(position, rotation, 5))
                assert (found[0].radiance_factor == found[1].radiance_factor).all()
        assert 0.2 < np.isfinite(horizon.clear_m).mean() < 0.99


def test_where_the_rays_begin_changes_no_hit(scene, engine):
    """Without the raster all rays begin above the highest ground; only the rounding of their way differs."""
    tops = tops_of(engine.surface.ground)
    with HeightfieldEngine(scene, settings(), CAMERA, SUN, 2, engine.surface) as one:
        for position, rotation in places(scene):
            found = []
            for one.tops in (tops, tops._replace(top_m=np.full_like(tops.top_m, np.inf))):
                found.append(one.render(position, rotation, 5))
            assert np.allclose(found[0].depth_m, found[1].depth_m, rtol=1e-9, atol=0)
            assert np.allclose(found[0].normal, found[1].normal, atol=1e-6)
            assert (found[0].sunlit == found[1].sunlit).mean() >= 0.9999


def test_rays_begin_near_the_ground_that_they_hit(scene, engine):
    """From 500 m above the site, a block of pixels begins above its ground, but far below the highest of the scene."""
    ground, tops = engine.surface.ground, tops_of(engine.surface.ground)
    position, rotation = np.array([0.0, 0.0, 500.0]), np.diag([1.0, -1.0, -1.0])
    depth = engine.render(position, rotation).depth_m
    above = []
    for row in range(0, CAMERA.height_px - 8, 8):
        for column in range(0, CAMERA.width_px - 8, 8):
            height = begin_m(tops, ground, position, rays_of(CAMERA) @ rotation, (column, column + 8, row, row + 8))
            above.append(height - (500 - depth[row : row + 8, column : column + 8].min()))
    assert min(above) > 0
    assert np.median(above) < 0.3 * (ground.highest_m - ground.lowest_m)


def test_the_part_below_a_block_holds_the_ways_of_its_rays(scene, engine):
    """From above the border of the inner square and above a diagonal, blocks lie in all parts, and some in several."""
    ground = engine.surface.ground
    half, tops, seen = float(ground.half_widths_m[0]), tops_of(ground), set()
    basis = rays_of(CAMERA) @ np.diag([1.0, -1.0, -1.0])
    for x, y in ((0.0, 0.0), (half, half), (-half, -half)):
        origin = np.array([x, y, ground.highest_m + 3 * half])
        for row in range(0, CAMERA.height_px - 8, 8):
            for column in range(0, CAMERA.width_px - 8, 8):
                block = column, column + 8, row, row + 8
                begin = begin_m(tops, ground, origin, basis, block)
                part = only_part(ground, origin, basis, block, begin)
                seen.add(part)
                if part < 0:
                    continue
                u, v, z = np.meshgrid(np.linspace(*block[:2], 9), np.linspace(*block[2:], 9), [begin, ground.lowest_m])
                ray = u[..., None] * basis[0] + v[..., None] * basis[1] + basis[2]
                at = origin + ray * ((z - origin[2]) / ray[..., 2])[..., None]
                x_m, y_m = at[..., 0], at[..., 1]
                inner = np.maximum(abs(x_m), abs(y_m)) < half
                sector = np.where(abs(x_m) > abs(y_m), np.where(x_m > 0, 2, 4), np.where(y_m > 0, 3, 1))
                assert (np.where(inner, 0, sector) == part).all()
    assert seen == {-1, 0, 1, 2, 3, 4}


def test_the_horizon_is_made_after_many_rays(scene, engine):
    position, rotation = pose(scene, *POSES[0])
    with HeightfieldEngine(scene, settings(samples=64), CAMERA, SUN, 2, engine.surface) as one:
        frames = [one.render(position, rotation, 5) for _ in range(2)]
        assert one.horizon is not NOWHERE
    assert (frames[0].radiance_factor == frames[1].radiance_factor).all()


@pytest.mark.parametrize("name", ["bounce", "earthshine"])
def test_light_that_it_does_not_render_is_refused(scene, name):
    config = settings().model_copy(update={"light": LightConfig(**{name: True})})
    with pytest.raises(UserError, match=f"dataset.light.{name}"):
        HeightfieldEngine(scene, config, CAMERA, SUN, 1)


def test_it_agrees_with_blender(scene):
    """Depth, labels and mean radiance of the same frame; both engines draw other samples, so pixels differ by noise."""
    pytest.importorskip("bpy")
    from perilune_render.engines.blender.renderer import Renderer

    config = settings(samples=16, exr=True)
    position, rotation = pose(scene, *POSES[2])
    shot = Shot(position, rotation, np.zeros(3), 7)
    found = []
    for make in (Renderer, HeightfieldEngine):
        with make(scene, config, CAMERA, SUN) as engine:
            source = FrameSource.of(engine, config, CAMERA, RimCircles.of_scene(scene))
            frame = source.take(shot)
            found.append((frame.radiance, source.labels(frame), frame.image.astype(float)))
    (first, labels, image), (second, other, same) = found
    both = np.isfinite(first.depth_m) & np.isfinite(second.depth_m)
    assert (np.abs(first.depth_m[both] / second.depth_m[both] - 1) < 1e-4).mean() > 0.999
    assert (first.sunlit == second.sunlit).mean() > 0.99
    assert np.isclose(first.radiance_factor.mean(), second.radiance_factor.mean(), rtol=2e-3)
    assert labels.crater_id.tolist() == other.crater_id.tolist()
    assert np.abs(labels.visible_fraction - other.visible_fraction).max() < 0.05
    assert np.median(np.abs(image - same)) <= 2


@pytest.mark.slow
def test_grazing_light_agrees_with_blender(scene):
    """Cycles lifts grazing shadow rays off the facets; without it this ground would be darker by some percent."""
    pytest.importorskip("bpy")
    from perilune_render.engines.blender.renderer import Renderer

    config, low = settings(samples=64), sun_direction(200, 15)
    position, rotation = pose(scene, *POSES[0])
    found = []
    for make in (Renderer, HeightfieldEngine):
        with make(scene, config, CAMERA, low) as engine:
            found.append(engine.render(position, rotation, 3))
    first, second = found
    cosine = first.normal @ low
    for least, most in ((0.03, 0.1), (0.1, 0.2), (0.2, 0.4)):
        chosen = (cosine > least) & (cosine < most)
        assert chosen.sum() > 200
        means = [each.radiance_factor[chosen].mean() for each in (first, second)]
        assert np.isclose(*means, rtol=0.02)
