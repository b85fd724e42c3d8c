"""Load the images of an explain run: labelled frames with the paper's masks G, and pairs of frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.explain.correlation.homography import true_homography
from perilune_train.motion.data import trajectories as navigation

RUN_PAIRS = 8
"""Largest number of consecutive pairs in a run. As in training, each run starts from the initial state of the LSTM."""


def ground_truth_mask(
    width_px: int, height_px: int, centres_px: ArrayLike, radii_px: ArrayLike, ring_factors: tuple[float, ...]
) -> Array:
    """The paper's mask G (height, width): 0 in craters, larger in rings around them, 1 elsewhere.

    Takes centres (N, 2) and radii (N,) in pixels. The four rings have the values 0.2, 0.4, 0.6 and 0.8 and end at
    ring_factors times the radius (equation "crater_width"). Where craters overlap, the smallest value is used; the
    paper does not define this case. The paper's text calls craters white and the background black, which contradicts
    the paper's numbers. This code follows the numbers.
    """
    mask = np.ones((height_px, width_px))
    levels = np.arange(len(ring_factors) + 1) / (len(ring_factors) + 1)
    for (x, y), radius in zip(np.asarray(centres_px, np.float64).reshape(-1, 2), np.asarray(radii_px), strict=True):
        reach = radius * ring_factors[-1]
        left, right = max(int(x - reach), 0), min(int(x + reach) + 1, width_px)
        top, bottom = max(int(y - reach), 0), min(int(y + reach) + 1, height_px)
        if left >= right or top >= bottom:
            continue
        u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        distance = np.hypot(u - x, v - y) / radius
        value = np.append(levels, 1.0)[np.searchsorted([1.0, *ring_factors], distance)]
        part = mask[top:bottom, left:right]
        np.minimum(part, value, out=part)
    return mask


def ellipse_mask(size_px: tuple[int, int], ellipses: Array) -> NDArray[np.float32]:
    """1 at pixels (height, width) whose centre is in one of the ellipses, 0 elsewhere.

    `ellipses` (M, 5) have centre x and y and semi-axes a and b in pixels, and the direction of a in radians.
    """
    mask = np.zeros(size_px, np.float32)
    for x, y, a, b, theta_rad in ellipses:
        reach = max(a, b) + 1
        left, right = max(int(x - reach), 0), min(int(x + reach) + 1, size_px[1])
        top, bottom = max(int(y - reach), 0), min(int(y + reach) + 1, size_px[0])
        if left >= right or top >= bottom:
            continue
        u, v = np.meshgrid(np.arange(left, right) + 0.5 - x, np.arange(top, bottom) + 0.5 - y)
        along, across = np.cos(theta_rad) * u + np.sin(theta_rad) * v, np.cos(theta_rad) * v - np.sin(theta_rad) * u
        mask[top:bottom, left:right][np.hypot(along / a, across / b) <= 1] = 1
    return mask


@dataclass(frozen=True)
class LabelledFrames:
    """N labelled frames."""

    images: NDArray[np.uint8]
    """Frames (N, height, width)."""
    truth: NDArray[np.float32]
    """The paper's masks G (N, height, width): 1 on background, 0 in craters."""
    labels: Sequence[FrameLabels]
    """Labels of each frame (N)."""
    radius_px: tuple[float, float]
    """Smallest and largest crater radius that is evaluated, pixels."""
    frame_ids: list[str]
    """Ids of the frames."""
    scene_ids: list[str]
    """Scene of each frame."""
    height_m: list[float]
    """Height of each camera above the plane of the landing site, metres."""

    @property
    def craters(self) -> NDArray[np.bool_]:
        """Pixels in craters (N, height, width)."""
        return self.truth == 0

    def perfect_masks(self, rows: Sequence[int]) -> NDArray[np.float32]:
        """Perfect masks (len(rows), height, width) of the frames `rows`: 1 in the ellipses of the selected craters."""
        _, height, width = self.images.shape
        labels = [self.labels[row] for row in rows]
        return np.stack([ellipse_mask((height, width), one.ellipses[one.selected]) for one in labels])


@dataclass(frozen=True)
class Pairs:
    """N pairs of consecutive frames, in runs of consecutive pairs."""

    images: NDArray[np.uint8]
    """The pairs (N, 2 height, width), the earlier frame above."""
    homographies: NDArray[np.float64]
    """True homographies (N, 3, 3) of the ground plane, from pixels of the earlier to pixels of the later frame."""
    translation_m: NDArray[np.float64]
    """True translations (runs, pairs per run, 3), metres, in O_C of the earlier frame."""
    position_m: NDArray[np.float64]
    """True positions (runs, pairs per run, 3) at the later frames, metres, in O_L."""
    pair_ids: list[str]
    """Scene, trajectory and step of each pair, separated by "/"."""
    scene_ids: list[str]
    """Scene of each pair."""
    height_m: list[float]
    """Height of the earlier camera of each pair above the plane of the landing site, metres."""


def labelled_frames(
    dataset: Dataset, split: str, detector: DetectConfig, count: int, ring_factors: tuple[float, ...]
) -> tuple[LabelledFrames, DetectSplit]:
    """Load a split; returns at most `count` of its frames, evenly spaced, and the whole split.

    The mask G contains only the craters that the labels of the detector's run select. Raises UserError if the dataset
    is not a detection dataset, or if the split is empty or damaged.
    """
    if dataset.info.kind != "detect":
        raise UserError(dataset.store, "kind", dataset.info.kind, "detect, a dataset with labels")
    whole = load_split(dataset, split, detector.labels)
    return frames_of(whole, evenly_spaced(len(whole), count), ring_factors), whole


def frames_of(split: DetectSplit, chosen: Sequence[int], ring_factors: tuple[float, ...]) -> LabelledFrames:
    """The frames of a split at the chosen indices."""
    labels = [split.labels[i] for i in chosen]
    height, width = split.frames.images.shape[1:]
    truth = [
        ground_truth_mask(
            width,
            height,
            frame_labels.ellipses[frame_labels.selected, :2],
            frame_labels.radius_px[frame_labels.selected],
            ring_factors,
        )
        for frame_labels in labels
    ]
    table = split.frames.table.iloc[list(chosen)]
    return LabelledFrames(
        split.frames.images[list(chosen)],
        np.stack(truth).astype(np.float32),
        labels,
        split.radius_px,
        table["frame_id"].tolist(),
        table["scene_id"].tolist(),
        [float(position[2]) for position in table["position_m"]],
    )


def first_descent(split: DetectSplit) -> list[int]:
    """Indices of the frames of the split's first trajectory."""
    ids = split.frames.table[["scene_id", "trajectory_id"]]
    return np.flatnonzero((ids == ids.iloc[0]).all(axis=1)).tolist()


def consecutive_pairs(descents: Sequence[navigation.Trajectory], count: int) -> Pairs:
    """Pairs in runs of consecutive pairs, spread evenly over descents and altitudes.

    All runs have the same length, at most RUN_PAIRS. The number of runs is `count` divided by this length, rounded
    down, and at least 1.
    """
    length = min(RUN_PAIRS, *(descent.n_pairs for descent in descents))
    runs = [(descent, start) for descent in descents for start in range(0, descent.n_pairs - length + 1, length)]
    return _pairs_of([(*runs[i], length) for i in evenly_spaced(len(runs), max(1, count // length))])


def pairs_of_descent(descent: navigation.Trajectory, count: int) -> Pairs:
    """At most `count` pairs of a descent, evenly spaced from the highest to the lowest pair."""
    return _pairs_of([(descent, step, 1) for step in evenly_spaced(descent.n_pairs, count)])


def _pairs_of(runs: Sequence[tuple[navigation.Trajectory, int, int]]) -> Pairs:
    """The pairs of runs of equal length; each run is given as (trajectory, first step, number of pairs)."""
    images, homographies, translations, positions, ids, scenes, heights = [], [], [], [], [], [], []
    for trajectory, start, length in runs:
        translations.append(trajectory.motion[0][start : start + length])
        positions.append(trajectory.pose[0][start : start + length])
        for step in range(start, start + length):
            images.append(np.concatenate([trajectory.images[step], trajectory.images[step + 1]]))
            poses = [(trajectory.position_m[k], trajectory.rotation_camera_from_site[k]) for k in (step, step + 1)]
            homographies.append(true_homography(trajectory.camera, *poses[0], *poses[1]))
            ids.append("/".join([*trajectory.ids, str(step)]))
            scenes.append(trajectory.ids[0])
            heights.append(float(trajectory.position_m[step][2]))
    truths = np.stack(translations), np.stack(positions)
    return Pairs(np.stack(images), np.stack(homographies), *truths, ids, scenes, heights)


def evenly_spaced(total: int, count: int) -> list[int]:
    """At most `count` indices below `total`, evenly spaced."""
    return np.unique(np.linspace(0, total - 1, count).astype(int)).tolist()
