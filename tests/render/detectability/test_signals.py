"""Expected images with and without single craters."""

import numpy as np
import pytest

from perilune_render.config.derived import CounterfactualConfig
from perilune_render.detectability.observer import observe
from perilune_render.detectability.removals import removal_batches
from perilune_render.detectability.signals import RemovalRenderer, heightfield_settings
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.sensor import expected
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.scene import grow_scene
from perilune_render.terrain.unstamped import Unstamped
from perilune_shared.geometry.ellipse import Ellipses
from perilune_shared.geometry.frames import sun_direction

SUN = sun_direction(100.0, 25.0)
SHOT = Shot(np.array([5.0, -4.0, 300.0]), np.diag([1.0, -1.0, -1.0]), np.zeros(3), 7)


@pytest.fixture(scope="module")
def view(small_config, camera):
    return view_envelope(camera, small_config.detect.flight)


@pytest.fixture(scope="module")
def config(small_config):
    return heightfield_settings(small_config)


def source_over(scene, config, camera, **changes):
    fixed = config.model_copy(update={"sensor": config.sensor.model_copy(update=changes)})
    engine = HeightfieldEngine(scene, fixed, camera, SUN)
    return FrameSource.of(engine, fixed, camera, RimCircles.of_scene(scene))


@pytest.fixture(scope="module")
def labels(scene, config, camera):
    """Labels of the frame over the whole scene."""
    source = source_over(scene, config, camera)
    labels = source.labels(source.take(SHOT))
    assert len(labels.crater_id) > 20
    return labels


def chosen(labels, rows):
    shapes = labels.ellipses
    return Ellipses(*(getattr(shapes, name)[rows] for name in ("cx_px", "cy_px", "a_px", "b_px", "theta_rad")))


@pytest.fixture(scope="module")
def removed(scene, config, camera, view, labels):
    """The frame with all craters, and the removals of all labels of the largest batch."""
    renderer = RemovalRenderer(scene, config, (camera, camera), SUN)
    frame = renderer.frame(SHOT)
    rows = max(removal_batches(scene.craters.chosen(labels.crater_id)), key=len)
    ids = labels.crater_id[rows]
    ground = Unstamped(scene, config, view, ids).without(ids)
    (removals,) = renderer.without(ground, [(frame, ids, chosen(labels, rows))])
    return frame, removals


def test_the_frame_with_all_craters_is_the_mean_of_the_rendered_frame(scene, config, camera, removed):
    source = source_over(scene, config, camera)
    frame, _ = removed
    mean, noise = expected(source.take(SHOT).exposure, config.sensor)
    assert np.array_equal(frame.mean, mean)
    assert np.array_equal(frame.noise, noise)


def test_a_removal_equals_a_frame_over_a_scene_without_the_crater(config, camera, view, removed):
    """Although many craters are removed at once, the window of each shows the removal of this crater alone."""
    frame, removals = removed
    assert len(removals) > 4
    for each in removals[:3]:
        alone = CounterfactualConfig(removed={3: (each.crater_id,)})
        ground = grow_scene(config.model_copy(update={"counterfactual": alone}), view, 3)
        source = source_over(ground, config, camera, exposure="fixed", exposure_time_s=frame.exposure_time_s)
        mean, _ = expected(source.take(SHOT).exposure, source.sensor)
        window = mean[each.rows, each.columns]
        difference = np.abs(window - each.without)[each.inside]
        # Single rays hit another facet if a height changes by rounding.
        assert np.quantile(difference, 0.95) < 0.05
        assert difference.mean() < 0.02 * np.abs(each.signal(frame.mean)).max() + 0.05


def test_pixels_outside_the_windows_do_not_change(removed):
    frame, removals = removed
    for each in removals:
        signal, background = each.signal(frame.mean), each.background(frame.mean)
        assert (signal[~each.inside] == 0).all()
        np.testing.assert_allclose(background + signal, frame.mean[each.rows, each.columns], atol=1e-4)


def test_deep_craters_are_more_detectable_than_worn_ones(scene, labels, removed):
    frame, removals = removed
    rows = np.searchsorted(scene.crater_id, [each.crater_id for each in removals])
    ratio = scene.rims.depth_m[rows] / scene.craters.diameter_m[rows]
    d_prime = np.array(
        [
            observe(
                each.signal(frame.mean),
                each.background(frame.mean),
                frame.noise[each.rows, each.columns],
                each.centre_px,
                each.axes_px,
            ).d_prime
            for each in removals
        ]
    )
    order = np.argsort(ratio)
    third = len(order) // 3
    assert np.median(d_prime[order[-third:]]) > 2 * np.median(d_prime[order[:third]])
    # The contrast of the labels is measured in the same frame, with the crater as part of its own clutter.
    contrast = labels.contrast[np.searchsorted(labels.crater_id, [each.crater_id for each in removals])]
    assert np.corrcoef(d_prime, contrast)[0, 1] > 0.6


def test_parts_that_are_rendered_again_equal_the_whole_frame(scene, config, camera):
    engine = HeightfieldEngine(scene, config, camera, SUN)
    whole = engine.render(*SHOT.pose, SHOT.render_seed)
    blank = engine.render(SHOT.position_m + np.array([40.0, 0, 0]), SHOT.rotation_camera_from_site, 1)
    wanted = np.zeros(whole.depth_m.shape, bool)
    wanted[40:70, 90:] = True
    again = engine.render_again(blank, wanted, *SHOT.pose, SHOT.render_seed)
    for name in ("radiance_factor", "depth_m"):
        assert np.array_equal(getattr(again, name)[wanted], getattr(whole, name)[wanted])
        assert np.array_equal(getattr(again, name)[:30], getattr(blank, name)[:30])
