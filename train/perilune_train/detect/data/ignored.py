"""Craters without a label that training and evaluation ignore: craters just outside the labelled range."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_quaternion

Array = NDArray[np.float64]
MARGIN = np.sqrt(0.5)
"""Craters down to this fraction of the smallest evaluated radius are ignored. The IoU of a smaller crater with a box in
the range of radii is below 0.5."""
_VARIES = 10.0
"""Largest ratio of a lens model's scale to the scale of a crater's image, which is also smaller if seen obliquely."""
_CENTRE, _NORMAL = ["x_m", "y_m", "z_m"], ["normal_x", "normal_y", "normal_z"]
_SIZE = ["diameter_m", "depth_m"]
CRATER_COLUMNS = ["crater_id", *_CENTRE, *_NORMAL, *_SIZE]
"""Columns of the table `craters` that `craters_of` needs."""


@dataclass(frozen=True)
class Craters:
    """Craters of one scene, sorted by id."""

    crater_id: NDArray[np.int64]
    """Ids within the scene (N,)."""
    centre_m: Array
    """Centres, metres, O_L (N, 3)."""
    normal: Array
    """Unit normals of the rims' planes, O_L (N, 3)."""
    diameter_m: Array
    """Diameters, metres (N,)."""
    depth_m: Array
    """Depths, metres (N,)."""


def read_craters(dataset: Dataset, scene_id: str) -> Craters:
    """Read the craters of one scene."""
    return craters_of(dataset.table("craters", CRATER_COLUMNS, scene_id=scene_id))


def craters_of(table: pa.Table) -> Craters:
    """The craters of one scene from their rows of the table `craters`, in any order."""
    table = table.sort_by("crater_id")
    sizes = (_real(table[name]) for name in _SIZE)
    return Craters(table["crater_id"].to_numpy(), _vectors(table, _CENTRE), _vectors(table, _NORMAL), *sizes)


def unlabelled_craters(
    craters: Craters,
    camera: Camera,
    frame: Mapping[Any, Any],
    radius_px: tuple[float, float],
    scale: tuple[float, float] = (1.0, 1.0),
    labelled: NDArray[np.int64] | None = None,
) -> Array:
    """Shapes (M, 10) of the craters to ignore in a frame.

    The columns are box (x0, y0, x1, y1), radius and ellipse (centre x and y, semi-axes, all in pixels, and direction in
    radians). `frame` is a row of the table `frames`, `radius_px` the range of labelled radii, and `labelled` has the
    ids of the craters with a label in this frame.

    Craters within a factor of sqrt(2) of the range, and craters centred off the image, are ignored, as COCO ignores
    objects outside its area range. A crater of 1.9 px looks like a crater of 2.1 px. If the smaller crater were
    background, training would lower the scores of both, and a detection of the smaller crater would be a false
    positive. Beyond that factor, the IoU of a crater with a box in the range is below 0.5. If frames will be resized by
    factors from scale[0] to scale[1], even smaller and larger craters are ignored.
    """
    low, high = radius_px[0] * MARGIN / max(scale[1], 1.0), radius_px[1] / MARGIN / min(scale[0], 1.0)
    rotation_camera_from_site = matrix_from_quaternion(frame["rotation_wxyz"])
    # Select by size first: a scene has a hundred thousand craters, and the other checks cost more.
    rows = _right_size(craters, camera, rotation_camera_from_site[2], frame["position_m"], (low, high))
    centre = camera_from_site(craters.centre_m[rows], frame["position_m"], rotation_camera_from_site)
    radius_m = craters.diameter_m[rows] / 2
    (u, v), reach_px = camera.project(centre).T, 2 * camera.scale_px * radius_m / camera.depth_m(centre)
    near = (u > -reach_px) & (u < camera.width_px + reach_px) & (v > -reach_px) & (v < camera.height_px + reach_px)
    if labelled is not None:
        near &= ~np.isin(craters.crater_id[rows], labelled)
    near = np.flatnonzero(near)
    shapes = project_circles(
        camera, centre[near], craters.normal[rows[near]] @ rotation_camera_from_site.T, radius_m[near]
    )
    box, radius = shapes.bounding_boxes(), shapes.radius_px()
    in_view = (box[:, 2:] > 0).all(1) & (box[:, :2] < [camera.width_px, camera.height_px]).all(1)
    in_view &= (radius >= low) & (radius <= high)
    ellipse = [shapes.cx_px, shapes.cy_px, shapes.a_px, shapes.b_px, shapes.theta_rad]
    return np.column_stack([box, radius, *ellipse])[in_view]


def _right_size(
    craters: Craters, camera: Camera, forward: Array, position_m: Any, range_px: tuple[float, float]
) -> NDArray[np.int64]:
    """Rows (M,) of the craters in front of the camera whose radius in the frame may be in a range.

    The radius is estimated as fx r / depth, with the depth along `forward`, the camera's z axis in O_L. The estimate is
    exact for level ground and a camera that looks straight down. The factors 0.8 and 2 allow for more than the effect
    of a tilt.
    """
    if camera.lens is not None:
        # The scale of a lens model varies within the image, so many candidates are projected.
        away_m = np.linalg.norm(craters.centre_m - np.asarray(position_m, np.float64), axis=1)
        wide = camera.scale_px * (craters.diameter_m / 2)
        return np.flatnonzero((wide > 0.8 * range_px[0] * away_m) & (wide < _VARIES * range_px[1] * away_m))
    depth_m = craters.centre_m @ forward - np.asarray(position_m, np.float64) @ forward
    scaled = camera.fx_px * (craters.diameter_m / 2)
    return np.flatnonzero((depth_m > 0) & (scaled > 0.8 * range_px[0] * depth_m) & (scaled < 2 * range_px[1] * depth_m))


def _real(column: pa.ChunkedArray) -> Array:
    return column.to_numpy().astype(np.float64, copy=False)


def _vectors(table: pa.Table, names: list[str]) -> Array:
    return np.column_stack([_real(table[name]) for name in names])
