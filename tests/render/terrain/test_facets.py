"""The mesh is fine enough: no facet has a side over a pixel in any frame of the presets' descents."""

from pathlib import Path

import numpy as np
import pytest

from perilune_render.config.dataset import DatasetConfig
from perilune_render.flight.plan import make_plan
from perilune_render.terrain.cache import cached_scene
from perilune_shared.config.resolve import resolve
from perilune_shared.geometry.camera import camera_from_site


def facets_px(vertices, faces, camera, position_m, rotation):
    """Longest side and longest diagonal of each facet with a corner in the image, pixels (N,)."""
    with np.errstate(invalid="ignore"):
        pixels = camera.project(camera_from_site(vertices, position_m, rotation)).astype(np.float32)
    seen = camera.inside(pixels)
    corners = pixels[faces[seen[faces].any(axis=1)]]
    sides, diagonals = [(0, 1), (1, 2), (2, 3), (3, 0)], [(0, 2), (1, 3)]
    lengths = [[np.hypot(*(corners[:, a] - corners[:, b]).T) for a, b in pairs] for pairs in (sides, diagonals)]
    return np.max(lengths[0], axis=0), np.max(lengths[1], axis=0)


HIGHLAND = Path(__file__).parents[3] / "configs" / "highland.yaml"


@pytest.mark.parametrize(
    ("preset", "kind", "place", "n_frames", "config_file"),
    [
        ("tiny", "detect", 0, 8, None),
        pytest.param("tiny", "nav", 0, 9, None, marks=pytest.mark.slow),
        pytest.param("tiny", "detect", 0, 8, HIGHLAND, marks=pytest.mark.slow),
        pytest.param("small", "detect", 5, 4, None, marks=pytest.mark.slow),
        pytest.param("small", "nav", 0, 3, None, marks=pytest.mark.slow),
    ],
)
def test_no_facet_is_over_a_pixel_in_any_frame(preset, kind, place, n_frames, config_file):
    """Nor has it a diagonal over a pixel, but for a few in the corners of the view on a slope.

    The scenes are those that `tiny` and test_data_manifests.py render, so that each is grown once.
    """
    config = resolve(DatasetConfig, "dataset", "perilune_render", preset, config_file)
    plan = make_plan(config, kind)
    scene = cached_scene(config, plan.view, plan.scenes[place].seed)
    x, y = scene.grid.vertices_xy()
    vertices, faces = np.stack([x, y, scene.height_m], axis=1), scene.grid.quads()
    for trajectory in plan.of_scene(plan.scenes[place].scene_id)[:2]:
        flight = trajectory.flight
        for index in np.unique(np.linspace(0, len(trajectory.splits) - 1, n_frames).astype(int)):
            pose = flight.position_m[index], flight.rotation_camera_from_site[index]
            side, diagonal = facets_px(vertices, faces, plan.camera, *pose)
            assert side.max() <= 1.0 and (diagonal > 1.0).mean() < 1e-4
            assert len(side) > 3 * plan.camera.width_px * plan.camera.height_px
