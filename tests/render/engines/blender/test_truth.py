"""Depth and normals of the EXRs are those of rays through the pixels' centres that Embree casts."""

import numpy as np
import pytest

from benchmarks.scene.truth import (
    CAMERA,
    RAYS,
    depth_errors,
    normal_errors_deg,
    projection_errors_px,
    rendered_frames,
)

SHARE = 0.999
"""Of the pixels, which must agree: where a triangle is seen edge on, or at its edge, rounding decides what is hit."""


@pytest.fixture(scope="module")
def frames():
    return rendered_frames()


def test_the_scene_shows_what_is_to_be_tested(frames):
    assert sum(frame.hits.rock.sum() for frame in frames) > 100
    facets = np.concatenate([frame.hits.facet[np.isfinite(frame.hits.depth)] for frame in frames])
    assert np.quantile(np.degrees(np.arccos(np.abs(facets[:, 2]))), 0.9) > 5
    assert any(np.isinf(frame.hits.depth).any() for frame in frames)


def test_depth_is_that_of_the_ray_through_the_pixels_centre(frames):
    for frame in frames:
        assert (np.isfinite(frame.radiance.depth_m.ravel()) == np.isfinite(frame.hits.depth)).mean() >= SHARE
        error, rock = depth_errors(frame)
        assert (error < 1e-4).mean() >= SHARE and (error[rock] < 1e-4).mean() > 0.98


def test_normals_are_those_of_the_ray_through_the_pixels_centre(frames):
    for frame in frames:
        error_deg, rock = normal_errors_deg(frame)
        assert (error_deg < 0.1).mean() >= SHARE and (error_deg[rock] < 0.1).mean() > 0.98


def test_a_place_found_by_depth_projects_to_its_own_pixel(frames):
    """There and back through O_L, in the float32 of the EXR."""
    for frame in frames:
        assert np.abs(projection_errors_px(frame)).max() < 0.01


def test_blenders_rays_go_through_the_pixels_centres(frames):
    """A ray beside the centre meets each facet at another depth: how far beside explains what difference there is?

    The plane with normal n through a point at depth Z on the ray r(u, v) gives dZ/du = -Z (n . dr/du) / (n . r).
    """
    for frame in frames:
        depth, hits, rotation = frame.radiance.depth_m.ravel(), frame.hits, frame.rotation
        both = np.isclose(depth, hits.depth, rtol=1e-4, atol=0) & np.isfinite(depth)
        slope = -hits.depth[both, None] * (hits.facet[both] @ rotation[:2].T) / CAMERA.fx_px
        slope /= np.sum(hits.facet[both] * (RAYS[both] @ rotation), axis=1)[:, None]
        difference = depth[both] - hits.depth[both]
        least_px = np.abs(difference) / np.linalg.norm(slope, axis=1)
        assert (least_px < 0.01).mean() >= SHARE
        of_the_frame_px = np.linalg.lstsq(slope, difference, rcond=None)[0]
        assert np.abs(of_the_frame_px).max() < 0.001
