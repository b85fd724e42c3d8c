"""Read the labels of a split's frames, scene by scene, into one array per column."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from perilune_shared.dataset.keys import FRAME_COLUMNS, KeyCheck
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import Selection
from perilune_train.data.shares import Share
from perilune_train.detect.data.ignored import Craters, read_craters, unlabelled_craters
from perilune_train.detect.ellipses import correlations_of

Array = NDArray[np.float64]
_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_ELLIPSE = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_SHAPE = [*_BOX, "radius_px", *_ELLIPSE]
_THRESHOLDED = ["radius_px", "visible_fraction", "sunlit_fraction", "contrast"]
LABEL_COLUMNS = list(dict.fromkeys(["crater_id", *_THRESHOLDED, *_SHAPE]))
"""Columns of the table `labels` that `frame_labels` needs."""


@dataclass(frozen=True)
class FrameLabels:
    """Labels of one frame."""

    boxes: Array
    """Box around the whole ellipse: x0, y0, x1, y1 in pixels (M, 4)."""
    radius_px: Array
    """Radius of the circle of equal area, pixels (M,)."""
    ellipses: Array
    """Centre x and y, semi-axes a and b in pixels, direction of a in radians (M, 5)."""
    selected: NDArray[np.bool_]
    """False for a crater to ignore: not selected, or not labelled (M,)."""
    labelled: NDArray[np.bool_]
    """False for a crater without a label: its radius is slightly out of range, or its centre is off the image (M,)."""
    depth_ratio: Array | None = None
    """Depth over diameter (M,), the freshness of a crater; NaN or None if unknown."""
    crowd: NDArray[np.bool_] | None = None
    """Whether a label is a region of many craters (M,), as COCO's `iscrowd`. Such a label is never selected. None if
    there are no such labels."""
    crater_id: NDArray[np.int64] | None = None
    """Id of each crater in its scene (M,), -1 for a crater without a label; None if there are no ids."""

    @property
    def outlines(self) -> Array:
        """Boxes with the correlations of their ellipses (M, 5), see detect/ellipses.py."""
        return np.column_stack([self.boxes, correlations_of(self.ellipses)])


@dataclass(frozen=True, slots=True)
class LabelLimits:
    """Limits that decide which craters are labels, which labels are selected, and which craters are ignored."""

    selection: Selection
    """Thresholds of the selected labels."""
    radius_px: tuple[float, float]
    """Range of radii that are labelled and evaluated, pixels."""
    zoom: tuple[float, float]
    """Smallest and largest factor by which frames will be resized; it widens the range of ignored craters."""


@dataclass(frozen=True)
class SplitLabels(Sequence[FrameLabels]):
    """Labels of N frames in joint arrays; an item is a view of the arrays.

    Worker processes share the arrays without copies.
    """

    shape: Array
    """Box (4), radius and ellipse (5) of all labels, frame after frame (L, 10)."""
    selected: NDArray[np.bool_]
    """See FrameLabels (L,)."""
    labelled: NDArray[np.bool_]
    """See FrameLabels (L,)."""
    depth_ratio: Array
    """See FrameLabels (L,)."""
    bounds: NDArray[np.int64]
    """Start of each frame's labels (N + 1,): frame i has the labels bounds[i] to bounds[i + 1] - 1."""
    crater_id: NDArray[np.int64]
    """See FrameLabels (L,)."""

    def __len__(self) -> int:
        return len(self.bounds) - 1

    @overload
    def __getitem__(self, index: int) -> FrameLabels: ...
    @overload
    def __getitem__(self, index: slice) -> list[FrameLabels]: ...
    def __getitem__(self, index: int | slice) -> FrameLabels | list[FrameLabels]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        rows = slice(self.bounds[index], self.bounds[index + 1])
        shape = self.shape[rows]
        return FrameLabels(
            shape[:, :4],
            shape[:, 4],
            shape[:, 5:],
            self.selected[rows],
            self.labelled[rows],
            self.depth_ratio[rows],
            crater_id=self.crater_id[rows],
        )


def read_split_labels(
    dataset: Dataset,
    table: pd.DataFrame,
    share: Share,
    limits: LabelLimits,
) -> tuple[SplitLabels, Array]:
    """Labels and ignored craters of this process's share, and sizes (S, 2) of the selected labels.

    The sizes are widths and heights in pixels, in all frames of the split, not only in the share. `table` has all
    frames of the split (`frame_table`). Memory holds the result and one scene's craters and labels at a time. Raises
    UserError if a file of the dataset cannot be read, or if a key refers to a missing row or is not unique.
    """
    rows = dataset.table("frames", FRAME_COLUMNS)
    check = KeyCheck(dataset, rows)
    frame_of_row = (
        pc.index_in(rows["frame_id"], pa.array(table["frame_id"].tolist(), rows["frame_id"].type))
        .fill_null(-1)
        .to_numpy()
    )
    names = ["frame_id", *LABEL_COLUMNS]
    frames, sizes, share_frames = _Joined(), [], share.of(len(table))
    with dataset.parts_kept_open():
        for scene_id, scene_frames in table.groupby("scene_id").indices.items():
            labels = dataset.table("labels", names, scene_id=str(scene_id))
            frame = frame_of_row[check.add_labels(labels)]
            wrong = (frame >= 0) & ~np.isin(frame, scene_frames)
            if wrong.any():
                got = labels["frame_id"][int(wrong.argmax())].as_py()
                expected = f"only frames of scene {scene_id} in its part; see `perilune-manifest validate`"
                raise UserError(dataset.store, "labels: frame_id", got, expected)
            craters = read_craters(dataset, str(scene_id))
            # Drop labels of other splits. Their frame is -1, so they are first in the order.
            order = np.argsort(frame, kind="stable")[np.count_nonzero(frame < 0) :]
            labels, bounds = labels.take(order), np.searchsorted(frame[order], [*scene_frames, scene_frames[-1] + 1])
            scene_labels = _SceneLabels.of(labels, craters, limits.selection)
            sizes.append((scene_labels.shape[:, 2:4] - scene_labels.shape[:, :2])[scene_labels.selected])
            for frame_index, start, stop in zip(scene_frames, bounds, bounds[1:], strict=False):
                if frame_index in share_frames:
                    part, row = slice(start, stop), table.iloc[frame_index].to_dict()
                    ids = scene_labels.crater_id[part]
                    ignored = unlabelled_craters(craters, dataset.camera, row, limits.radius_px, limits.zoom, ids)
                    frames.add(scene_labels.part(part), ignored)
    check.finish()
    return frames.joined(), np.concatenate(sizes)


def frame_labels(
    where: object,
    camera: Camera,
    row: dict[str, Any],
    labels: pa.Table,
    craters: Craters,
    limits: LabelLimits,
) -> FrameLabels:
    """Labels and ignored craters of one frame.

    `row` is the frame's row of the table `frames`, `labels` its rows of the table `labels`, and `craters` the craters
    of its scene. Raises UserError about `where` if the crater of a label is missing.
    """
    ids = labels["crater_id"].to_numpy()
    known = (np.append(craters.crater_id, -1)[np.searchsorted(craters.crater_id, ids)] == ids) & (ids >= 0)
    if not known.all():
        got = f"{ids[known.argmin()]} in {row['frame_id']}"
        raise UserError(where, "labels: crater_id", got, "craters; see `perilune-manifest validate`")
    scene_labels = _SceneLabels.of(labels, craters, limits.selection)
    ignored = unlabelled_craters(craters, camera, row, limits.radius_px, limits.zoom, scene_labels.crater_id)
    frames = _Joined()
    frames.add(scene_labels, ignored)
    return frames.joined()[0]


@dataclass(frozen=True)
class _SceneLabels:
    """Labels of one scene, sorted by frame."""

    crater_id: NDArray[np.int64]
    """Ids within the scene (L,)."""
    shape: Array
    """See SplitLabels (L, 10)."""
    selected: NDArray[np.bool_]
    """See FrameLabels (L,)."""
    depth_ratio: Array
    """See FrameLabels (L,)."""

    @classmethod
    def of(cls, labels: pa.Table, craters: Craters, selection: Selection) -> "_SceneLabels":
        """Convert rows of the table `labels`; all their craters must exist."""
        ids = labels["crater_id"].to_numpy()
        row = np.searchsorted(craters.crater_id, ids)
        depth_m, diameter_m = craters.depth_m[row], craters.diameter_m[row]
        columns = {name: labels[name].to_numpy() for name in _THRESHOLDED}
        chosen = selected({**columns, "depth_m": depth_m, "diameter_m": diameter_m}, selection)
        shape = np.column_stack([labels[name].to_numpy().astype(np.float64, copy=False) for name in _SHAPE])
        return cls(ids, shape, chosen, depth_m / diameter_m)

    def part(self, rows: slice) -> "_SceneLabels":
        """Some of the labels."""
        return _SceneLabels(self.crater_id[rows], self.shape[rows], self.selected[rows], self.depth_ratio[rows])


class _Joined:
    """Collects the labels and the ignored craters of frames, one frame at a time."""

    def __init__(self) -> None:
        self.shape: list[Array] = []
        self.selected: list[NDArray[np.bool_]] = []
        self.labelled: list[NDArray[np.bool_]] = []
        self.depth_ratio: list[Array] = []
        self.crater_id: list[NDArray[np.int64]] = []
        self.counts: list[int] = []

    def add(self, labels: _SceneLabels, ignored: Array) -> None:
        """Add a frame with M labels and K ignored craters, whose shapes are (K, 10)."""
        nothing = np.zeros(len(ignored), np.bool_)
        self.shape += [labels.shape, ignored]
        self.selected += [labels.selected, nothing]
        self.labelled += [np.ones(len(labels.shape), np.bool_), nothing]
        self.depth_ratio += [labels.depth_ratio, np.full(len(ignored), np.nan)]
        self.crater_id += [labels.crater_id, np.full(len(ignored), -1)]
        self.counts.append(len(labels.shape) + len(ignored))

    def joined(self) -> SplitLabels:
        """The labels of all frames."""
        return SplitLabels(
            np.concatenate(self.shape),
            np.concatenate(self.selected),
            np.concatenate(self.labelled),
            np.concatenate(self.depth_ratio),
            np.cumsum([0, *self.counts]),
            np.concatenate(self.crater_id),
        )
