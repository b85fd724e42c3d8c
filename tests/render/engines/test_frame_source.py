"""Frames from a pose and a seed, by an engine that is not Blender."""

from dataclasses import replace

import numpy as np
import pytest
from tests.helpers.flat_engine import FlatEngine
from tests.helpers.scenes import config_with

from perilune_render.config.cameras import CameraConfig, DistortionConfig
from perilune_render.config.dataset import LightConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.flight.lens import camera_of
from perilune_render.imaging.sensor import expected
from perilune_render.labels.frame_labels import RimCircles
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import sun_direction

CAMERA = Camera.from_field_of_view(96, 64, 50.0)
SUN = sun_direction(70, 30)
SHOT = Shot(np.array([3.0, -5.0, 120.0]), ROTATION_CAMERA_FROM_BODY, np.zeros(3), seed=5)
CONFIG = config_with(light=LightConfig(photometry="lommel_seeliger"))
CIRCLES = RimCircles(
    np.array([4, 7]), np.array([[10.0, 0, 0], [-20, 5, 0]]), np.tile([0.0, 0, 1], (2, 1)), np.array([8.0, 5.0])
)


def source_of(camera=CAMERA, config=CONFIG, exr_camera=None):
    engine = FlatEngine(config.light.photometry, exr_camera or camera.covering_pinhole(), SUN)
    return FrameSource.of(engine, config, camera, CIRCLES)


def test_a_frame_is_that_of_its_shot_alone():
    source, again = source_of(), source_of()
    frame = source.take(SHOT)
    assert np.array_equal(frame.image, again.take(SHOT).image)
    for other in (replace(SHOT, seed=6), replace(SHOT, index=1)):
        noisy = source.take(other)
        assert np.array_equal(noisy.radiance.radiance_factor, frame.radiance.radiance_factor)
        assert 0.3 < (noisy.image != frame.image).mean() < 1.0


def test_the_image_is_the_radiance_through_the_sensor():
    source = source_of()
    frame = source.take(SHOT)
    mean, noise = expected(frame.exposure, source.sensor)
    assert frame.image.shape == (64, 96) and frame.image.dtype == np.uint8
    # Automatic exposure brings the brightest percent to 0.8 of 255.
    assert np.percentile(mean, 99) == pytest.approx(0.8 * 255, abs=1)
    assert abs(((frame.image - mean) / noise).mean()) < 0.05
    assert ((frame.image - mean) / noise).std() == pytest.approx(1, abs=0.05)


def test_labels_are_where_the_camera_projects_the_rims():
    source = source_of()
    frame = source.take(SHOT)
    labels = source.labels(frame)
    assert labels.crater_id.tolist() == [4, 7]
    centres = CAMERA.project(camera_from_site(CIRCLES.centre_m, *SHOT.pose))
    assert np.allclose(np.column_stack([labels.ellipses.cx_px, labels.ellipses.cy_px]), centres, atol=1e-9)
    assert np.allclose(labels.ellipses.radius_px(), CAMERA.fx_px * CIRCLES.radius_m / 120)
    assert (labels.visible_fraction == 1).all() and (labels.sunlit_fraction == 1).all()
    # Flat ground has the rims' circles, but no bowls.
    assert (np.abs(labels.contrast) < 3).all()
    index = source.crater_index(frame)
    assert [index[int(y), int(x)] for x, y in centres] == [4, 7] and set(np.unique(index)) == {-1, 4, 7}


def test_a_distorted_camera_sees_a_pinholes_rendering():
    lens = DistortionConfig(k1=-0.2, k2=0.02)
    camera = camera_of(CameraConfig(width_px=96, height_px=64, distortion=lens))
    source = source_of(camera)
    frame = source.take(SHOT)
    rendered = source.engine.camera
    assert rendered.distortion == (0, 0, 0, 0, 0) and rendered.width_px > 96
    assert frame.image.shape == (64, 96) and frame.radiance.depth_m.shape == (rendered.height_px, rendered.width_px)
    centres = camera.project(camera_from_site(CIRCLES.centre_m, *SHOT.pose))
    labels = source.labels(frame)
    assert np.allclose(np.column_stack([labels.ellipses.cx_px, labels.ellipses.cy_px]), centres, atol=0.2)


def test_an_engine_that_sees_less_than_the_camera_is_refused():
    with pytest.raises(ValueError, match="expected a camera that covers"):
        source_of(exr_camera=replace(CAMERA, width_px=95))
