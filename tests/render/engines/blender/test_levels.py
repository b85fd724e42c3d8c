"""Frames on both sides of a change of level: the same ground, and no jump between consecutive frames."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from benchmarks.scene.tracking import klt_residuals_px
from perilune_render.config.dataset import KindConfig
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.engines.frame_source import Frame, FrameSource, Shot
from perilune_render.flight.trajectories import fly
from perilune_render.flight.view import view_envelope
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.level_ground import on_level
from perilune_render.terrain.levels import cut_levels, level_index
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import sun_direction

pytestmark = pytest.mark.slow

CAMERA = Camera.from_field_of_view(160, 160, 50.0)
SUN = sun_direction(90, 30)
FLIGHT = {"azimuth_deg": {"low": 0.0, "high": 360.0}}
KIND = KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=4, split_by="scene", flight=FLIGHT)
CONFIG = config_with(detect=KIND, terrain={"max_vertices": 600_000}, render={"exr": True})
EACH = config_with(detect=KIND, render={"exr": True})
"""Settings under which the ground of a single level is one mesh."""
LEVELS = (5, 4, 3, 2, 1, 0)


@dataclass
class Descent:
    """Frames around the changes between some levels, each pair of consecutive frames on both levels."""

    scene: Scene
    shots: dict[int, Shot]
    firsts: dict[int, int]
    """Index of the first shot of each level but the coarsest of LEVELS."""
    frames: dict[tuple[int, int], Frame]
    """Frames by level and index of the shot."""
    labels: dict[tuple[int, int], object]


@pytest.fixture(scope="module")
def descent():
    scene = grow_scene(CONFIG, view_envelope(CAMERA, CONFIG.detect.flight), 5)
    flight = fly(CONFIG.detect.flight, 100, 3)
    approach = flight.nominal.approach_deg
    levels = cut_levels(CONFIG.terrain, scene.view, approach)
    level = np.array([level_index(levels, z) for z in flight.position_m[:, 2]])
    found = Descent(scene, {}, {k: int(np.flatnonzero(level == k)[0]) for k in LEVELS[1:]}, {}, {})
    for k in LEVELS:
        pairs = [found.firsts[other] for other in (k, k - 1) if other in found.firsts]
        with Renderer(on_level(scene, levels[k].grid, CONFIG.terrain.boulders), EACH, CAMERA, SUN) as engine:
            source = FrameSource.of(engine, CONFIG, CAMERA, RimCircles.of_scene(scene))
            for i in sorted({index for first in pairs for index in (first - 1, first)}):
                pose = flight.position_m[i], flight.rotation_camera_from_site[i]
                found.shots[i] = Shot(*pose, flight.velocity_mps[i], seed=7, index=i, approach_deg=approach)
                found.frames[k, i] = source.take(found.shots[i])
                found.labels[k, i] = source.labels(found.frames[k, i])
    return found


def test_a_renderer_shows_the_level_of_each_pose_in_any_order(descent):
    first = descent.firsts[1]
    with Renderer(descent.scene, CONFIG, CAMERA, SUN) as engine:
        for index, k in ((first, 1), (first - 1, 2), (first, 1)):
            shot, expected = descent.shots[index], descent.frames[k, index].radiance
            again = engine.render(*shot.pose, shot.render_seed, shot.approach_deg)
            assert np.array_equal(again.radiance_factor, expected.radiance_factor)
            assert np.array_equal(again.depth_m, expected.depth_m)


@pytest.mark.parametrize("k", LEVELS[1:])
def test_two_levels_show_the_same_ground(descent, k):
    first = descent.firsts[k]
    one, other = descent.frames[k + 1, first].radiance, descent.frames[k, first].radiance
    pixel_m = descent.shots[first].position_m[2] / CAMERA.fx_px
    assert np.median(np.abs(one.depth_m - other.depth_m)) < 0.01 * pixel_m
    assert np.percentile(np.abs(one.depth_m - other.depth_m), 99) < 0.1 * pixel_m
    difference = one.radiance_factor - other.radiance_factor
    assert abs(difference.mean()) < 0.01 * one.radiance_factor.mean()
    assert difference.std() < 0.2 * one.radiance_factor.std()


@pytest.mark.parametrize("k", LEVELS[1:])
def test_labels_do_not_depend_on_the_level(descent, k):
    one, other = (descent.labels[level, descent.firsts[k]] for level in (k + 1, k))
    assert len(one.crater_id) > 50 and np.array_equal(one.crater_id, other.crater_id)
    for name in ("cx_px", "cy_px", "a_px", "b_px", "theta_rad"):
        assert np.array_equal(getattr(one.ellipses, name), getattr(other.ellipses, name))
    assert np.abs(one.visible_fraction - other.visible_fraction).max() <= 0.1


def test_features_are_tracked_across_a_change_of_level_as_well_as_within_one(descent):
    def residuals(first_level, second_level):
        """Residuals of the frames before and after each change of level, on these of its two levels."""
        found = []
        for k, first in descent.firsts.items():
            frames = descent.frames[k + first_level, first - 1], descent.frames[k + second_level, first]
            seen = [replace(frame.radiance, radiance_factor=frame.image.astype(float)) for frame in frames]
            found.append(klt_residuals_px(CAMERA, *seen, *(frame.shot.pose for frame in frames)))
        return np.concatenate(found)

    within, across = np.concatenate([residuals(0, 0), residuals(1, 1)]), residuals(1, 0)
    assert len(across) > 500 and len(across) > 0.9 * len(within) / 2
    assert np.median(across) < 1.1 * np.median(within)
    assert np.percentile(across, 90) < 1.1 * np.percentile(within, 90)
