import dataclasses

import numpy as np
import pytest
from tests.helpers.elevation_models import PLACED, POLAR, rough, write
from tests.helpers.scenes import flat_scene

from perilune_render.dataset.real_ground import draw_outline, outline_m, real_ground_share
from perilune_render.terrain.elevation.model import beyond_m, raster_places, read_elevation
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera

CAMERA = Camera.from_field_of_view(64, 64, 2 * np.degrees(np.arctan(0.5)))
DOWN = ROTATION_CAMERA_FROM_BODY


def test_the_share_is_that_of_the_pixels_on_the_model():
    scene = flat_scene(400, 81)
    x, _ = scene.grid.vertices_xy()
    scene = dataclasses.replace(scene, real=x < 25)
    depth = np.full((64, 64), 100.0)
    # 100 m up the frame is 100 m wide: three quarters of it lie at x < 25, to half a vertex spacing (2.5 m).
    position = np.array([0.0, 0.0, 100.0])
    assert real_ground_share(scene, CAMERA, position, DOWN, depth) == pytest.approx(0.75, abs=0.04)
    depth[:32] = np.inf
    assert real_ground_share(scene, CAMERA, position, DOWN, depth) == pytest.approx(0.75, abs=0.04)
    assert real_ground_share(scene, CAMERA, position, DOWN, np.full((64, 64), np.inf)) == 0
    assert real_ground_share(flat_scene(400, 81), CAMERA, position, DOWN, depth) == 0


def test_the_outline_runs_along_the_edge_of_the_model(tmp_path):
    model = read_elevation(write(tmp_path / "a.tif", rough(), POLAR, PLACED))
    outline = outline_m(model)
    column, row = raster_places(model, *outline.T)
    to_edge = np.min(np.abs([column, column - 150, row, row - 150]), axis=0)
    assert to_edge.max() < 1e-3 and beyond_m(model, column, row).max() < 0.01
    picture = np.zeros((128, 128, 3), np.uint8)
    scene = flat_scene(1600, 81)
    draw_outline(picture, outline, scene, CAMERA, np.array([0.0, 0.0, 1500.0]), DOWN)
    # A square of 750 m, half of the 1500 m that the frame shows.
    assert 0.5 < np.ptp(np.nonzero(picture.any(axis=2))[0]) / 128 < 0.72 and not picture[60:68, 60:68].any()
