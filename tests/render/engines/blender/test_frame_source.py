"""Blender as the engine of a frame source, compared with one in NumPy."""

import numpy as np
from tests.helpers.flat_engine import FlatEngine
from tests.helpers.scenes import config_with, flat_scene, round_craters

from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.labels.frame_labels import RimCircles
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector, sun_direction


def test_two_engines_give_the_same_frame_of_flat_ground():
    camera, sun = Camera.from_field_of_view(96, 64, 50.0), sun_direction(70, 30)
    config = config_with(light=LightConfig(photometry="lommel_seeliger"), render=RenderConfig(exr=True))
    scene = flat_scene(400, 41, round_craters([(10, 0, 16, 0.1), (-20, 5, 10, 0.1)]))
    circles = RimCircles.of_scene(scene)
    tilted = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(np.radians([8, -12, 30]))
    shots = [Shot(np.array([3.0, -5.0, 120.0]), tilted, np.array([0.0, 40.0, -20.0]), 5, index) for index in range(2)]
    other = FrameSource.of(FlatEngine("lommel_seeliger", camera, sun), config, camera, circles)
    with Renderer(scene, config, camera, sun) as engine:
        source = FrameSource.of(engine, config, camera, circles)
        frames = [source.take(shot) for shot in shots]
        assert np.array_equal(source.take(shots[0]).image, frames[0].image)
    for shot, frame in zip(shots, frames, strict=True):
        same = other.take(shot)
        # The noise is drawn from the shot's seed by both, so little is left but float32.
        assert np.abs(frame.image.astype(int) - same.image).max() <= 2
        assert np.allclose(frame.radiance.depth_m, same.radiance.depth_m, rtol=1e-5)
        labels, expected = source.labels(frame), other.labels(same)
        assert labels.crater_id.tolist() == expected.crater_id.tolist() == [0, 1]
        assert np.allclose(labels.visible_fraction, expected.visible_fraction)
        assert np.array_equal(source.crater_index(frame), other.crater_index(same))
    assert (frames[0].image != frames[1].image).any()
