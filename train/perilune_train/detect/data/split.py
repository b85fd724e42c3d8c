"""Frames and labels of a split for the detector; selection of labels to find and to ignore."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.labels.selection import label_bound_px, read_labels, selected
from perilune_train.data.frames import FrameStore, load_frames
from perilune_train.detect.config import COARSEST_STRIDE, LabelSettings

Array = NDArray[np.float64]
_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_CRATER = ["scene_id", "crater_id", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "diameter_m"]
_ELLIPSE = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_SHAPE = [*_BOX, "radius_px", *_ELLIPSE]

MARGIN = np.sqrt(0.5)
"""Craters below the smallest evaluated radius are ignored down to this fraction of it. Smaller ones cannot reach an IoU
of 0.5 with a box in the range."""


@dataclass(frozen=True)
class FrameLabels:
    """Labels of one frame."""

    boxes: Array
    """Box around the whole ellipse: x0, y0, x1, y1 in pixels (M, 4)."""
    radius_px: Array
    """Radius of the circle of equal area, pixels (M,)."""
    ellipses: Array
    """Centre x and y, semi-axes a and b in pixels, direction of a in radians (M, 5), for drawing."""
    selected: NDArray[np.bool_]
    """False for a crater to ignore: hardly visible, or not labelled (M,)."""
    labelled: NDArray[np.bool_]
    """False for a crater that is not in the manifest's labels: slightly too small, too large, or off the image (M,)."""
    depth_ratio: Array | None = None
    """Depth over diameter (M,), the freshness of a crater; NaN or None if unknown."""


@dataclass(frozen=True)
class DetectSplit:
    """One split in memory."""

    frames: FrameStore
    """Pixels and poses."""
    labels: list[FrameLabels]
    """One entry per frame."""
    radius_px: tuple[float, float]
    """Range of radii that are labelled and evaluated, pixels."""

    def __len__(self) -> int:
        return len(self.labels)


def load_split(
    dataset: Dataset, split: str, settings: LabelSettings, scale: tuple[float, float] = (1.0, 1.0)
) -> DetectSplit:
    """Load frames and labels of a split. Raises UserError on damaged files and on frame sizes unfit for the network.

    `scale` has the smallest and the largest zoom factor that will be applied to frames; the range of ignored craters is
    extended accordingly. The edge account needs a largest factor of 1 / EDGE.
    """
    camera = dataset.info.camera
    for field, size in (("width_px", camera.width_px), ("height_px", camera.height_px)):
        if size % COARSEST_STRIDE:
            nearest = max(1, round(size / COARSEST_STRIDE)) * COARSEST_STRIDE
            expected = f"a multiple of {COARSEST_STRIDE}, the network's coarsest stride"
            raise UserError(dataset.root, field, size, f"{expected}; render or develop the frames with {nearest}")
    frames = load_frames(dataset, split)
    labels = read_labels(dataset, [*_BOX, *_ELLIPSE], split)
    radius_px = _evaluated_range(dataset, settings)
    shapes, ids = labels[_SHAPE].to_numpy(np.float64), labels["crater_id"].to_numpy()
    is_selected = selected(labels, settings)
    depth_ratio = (labels["depth_m"] / labels["diameter_m"]).to_numpy(np.float64)
    rows_of = labels.groupby("frame_id").indices
    craters = dataset.table("craters", _CRATER).to_pandas()
    by_scene = {str(name): (part, *_places(part)) for name, part in craters.groupby("scene_id")}
    no_craters = (craters.iloc[:0], *_places(craters.iloc[:0]))
    parts = []
    for frame in frames.table.to_dict("records"):
        rows = rows_of.get(frame["frame_id"], np.empty(0, np.intp))
        # First select by size: a scene has a hundred thousand craters, and the other checks cost more.
        scene, points, radius_m = by_scene.get(frame["scene_id"], no_craters)
        near = _right_size(points, radius_m, camera.intrinsics(), frame, _ignored_range(radius_px, scale))
        others = scene[near]
        others = others[~others["crater_id"].isin(ids[rows])]
        ignored = unlabelled_craters(others, camera.intrinsics(), frame, radius_px, scale)
        shape = np.concatenate([shapes[rows], ignored[_SHAPE].to_numpy(np.float64)])
        labelled = np.arange(len(shape)) < len(rows)
        chosen = np.zeros(len(shape), np.bool_)
        chosen[: len(rows)] = is_selected[rows]
        ratio = np.concatenate([depth_ratio[rows], np.full(len(ignored), np.nan)])
        parts.append(FrameLabels(shape[:, :4], shape[:, 4], shape[:, 5:], chosen, labelled, ratio))
    return DetectSplit(frames, parts, radius_px)


def _places(craters: pd.DataFrame) -> tuple[Array, Array]:
    """Centres (N, 3) and radii (N,) in metres."""
    return craters[["x_m", "y_m", "z_m"]].to_numpy(np.float64), craters["diameter_m"].to_numpy(np.float64) / 2


def _ignored_range(radius_px: tuple[float, float], scale: tuple[float, float]) -> tuple[float, float]:
    return radius_px[0] * MARGIN / max(scale[1], 1.0), radius_px[1] / MARGIN / min(scale[0], 1.0)


def _right_size(
    points_m: Array, radius_m: Array, camera: Camera, frame: dict[Any, Any], range_px: tuple[float, float]
) -> NDArray[np.bool_]:
    """Select craters (N,) in front of the camera whose radius in the frame may be in a range, from their depth only.

    Exact for level ground and a level camera; the effect of a tilt is well within the margins.
    """
    forward = matrix_from_quaternion(frame["rotation_wxyz"])[2]
    depth_m = points_m @ forward - np.asarray(frame["position_m"], np.float64) @ forward
    scaled = camera.fx_px * radius_m
    return (depth_m > 0) & (scaled > 0.8 * range_px[0] * depth_m) & (scaled < 2 * range_px[1] * depth_m)


def _evaluated_range(dataset: Dataset, settings: LabelSettings) -> tuple[float, float]:
    """Smallest and largest selected radius, pixels; limits that the selection does not set are those of the labels."""
    if settings.radius_px is None:
        return _labelled_range(dataset)
    smallest_px, largest_px = settings.radius_px
    return smallest_px, label_bound_px(dataset.info) if largest_px is None else largest_px


def _labelled_range(dataset: Dataset) -> tuple[float, float]:
    """Smallest and largest radius of all labels of a dataset, pixels."""
    radius_px = dataset.table("labels", ["radius_px"]).to_pandas()["radius_px"]
    return float(radius_px.min()), float(radius_px.max())


def unlabelled_craters(
    craters: pd.DataFrame,
    camera: Camera,
    frame: dict[Any, Any],
    radius_px: tuple[float, float],
    scale: tuple[float, float] = (1.0, 1.0),
) -> pd.DataFrame:
    """Craters of the scene that a frame shows just outside the labelled range, as rows to ignore.

    A crater of 1.9 px looks like one of 2.1 px. If the first were background, training would lower the scores of both,
    and a detection of the first would be a false positive. So two kinds of crater are ignored, as COCO ignores objects
    outside its area range: craters within a factor of sqrt(2) of the range (others cannot reach an IoU of 0.5 with a
    box in the range) and craters with their centre off the image. If frames will be enlarged or shrunk (`scale`, see
    load_split), smaller and larger ones are ignored too. `frame` is a row of the table.
    """
    low, high = _ignored_range(radius_px, scale)
    points, radius_m = _places(craters)
    sized = _right_size(points, radius_m, camera, frame, (low, high))
    craters, points, radius_m = craters[sized], points[sized], radius_m[sized]
    rotation = matrix_from_quaternion(frame["rotation_wxyz"])
    centre = camera_from_site(points, frame["position_m"], rotation)
    middle, rough_px = camera.project(centre), camera.fx_px * radius_m / centre[:, 2]
    near = (middle > -2 * rough_px[:, None]).all(1)
    near &= (middle < np.array([camera.width_px, camera.height_px]) + 2 * rough_px[:, None]).all(1)
    normals = craters[["normal_x", "normal_y", "normal_z"]].to_numpy(np.float64)[near] @ rotation.T
    shapes = project_circles(camera, centre[near], normals, radius_m[near])
    columns = [*shapes.bounding_boxes().T, shapes.cx_px, shapes.cy_px, shapes.a_px, shapes.b_px, shapes.theta_rad]
    rows = pd.DataFrame(dict(zip([*_BOX, *_ELLIPSE], columns, strict=True)))
    rows["radius_px"], rows["selected"], rows["labelled"] = shapes.radius_px(), False, False
    box = rows[_BOX].to_numpy(np.float64)
    seen = (box[:, 2:] > 0).all(1) & (box[:, :2] < [camera.width_px, camera.height_px]).all(1)
    return rows[seen & rows["radius_px"].between(low, high).to_numpy()]
