"""Frames and labels for the detector: what to find, what to ignore, augmentation, batches."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils import data as torch_data

from perilune_shared.camera import Camera, camera_from_site
from perilune_shared.ellipse import project_circles
from perilune_shared.errors import UserError
from perilune_shared.frames import matrix_from_quaternion
from perilune_shared.manifest import Dataset
from perilune_shared.selection import read_labels, selected
from perilune_train.data.frames import FrameStore, load_frames, normalised
from perilune_train.detect.assign import Targets
from perilune_train.detect.config import AugmentSettings, DetectConfig, LabelSettings

Array = NDArray[np.float64]
_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_CRATER = ["scene_id", "crater_id", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "diameter_m"]
_ELLIPSE = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_SHAPE = [*_BOX, "radius_px", *_ELLIPSE]

_MARGIN = np.sqrt(0.5)
"""Craters below the least radius are ignored down to this share of it: no box in range overlaps lesser ones by half."""


@dataclass(frozen=True)
class FrameLabels:
    """Labels of one frame."""

    boxes: Array
    """Tight on the whole ellipse: x0, y0, x1, y1 in pixels (M, 4)."""
    radius_px: Array
    """Radius of the circle of equal area, pixels (M,)."""
    ellipses: Array
    """Centre x and y, semi-axes a and b in pixels, direction of a in radians (M, 5), for drawing."""
    wanted: NDArray[np.bool_]
    """False for a crater that is ignored: hardly visible, or not labelled (M,)."""
    labelled: NDArray[np.bool_]
    """False for a crater that is not in the manifest's labels: a little too small, too large, or off the image (M,)."""
    depth_ratio: Array | None = None
    """Depth over diameter (M,), by which a crater is fresh or worn; NaN or None where it is not known."""


@dataclass(frozen=True)
class DetectSplit:
    """One split in memory."""

    frames: FrameStore
    """Pixels and poses."""
    labels: list[FrameLabels]
    """One entry a frame."""
    radius_px: tuple[float, float]
    """Radii that are labelled and judged, pixels."""

    def __len__(self) -> int:
        return len(self.labels)


def load_split(dataset: Dataset, split: str, settings: LabelSettings, enlarged: float = 1.0) -> DetectSplit:
    """Frames and labels of a split. Raises UserError on damaged files and on frames that the network cannot take.

    `enlarged` is the largest factor by which frames will be enlarged: what is ignored reaches down accordingly.
    """
    camera = dataset.info.camera
    for field, size in (("width_px", camera.width_px), ("height_px", camera.height_px)):
        if size % 32:
            raise UserError(dataset.root, field, size, "a multiple of 32, the network's coarsest stride")
    frames = load_frames(dataset, split)
    labels = read_labels(dataset, [*_BOX, *_ELLIPSE], split)
    radius_px = settings.radius_px or _labelled_range(dataset)
    shapes, ids = labels[_SHAPE].to_numpy(np.float64), labels["crater_id"].to_numpy()
    wanted, depth_ratio = selected(labels, settings), (labels["depth_m"] / labels["diameter_m"]).to_numpy(np.float64)
    rows_of = labels.groupby("frame_id").indices
    craters = dataset.table("craters", _CRATER).to_pandas()
    by_scene = {str(name): (part, *_places(part)) for name, part in craters.groupby("scene_id")}
    nowhere = (craters.iloc[:0], *_places(craters.iloc[:0]))
    parts = []
    for frame in frames.table.to_dict("records"):
        rows = rows_of.get(frame["frame_id"], np.empty(0, np.intp))
        # Of the hundred thousand craters of a scene, those of the right size first: the rest is then cheap.
        scene, points, radius_m = by_scene.get(frame["scene_id"], nowhere)
        near = _right_size(points, radius_m, camera.intrinsics(), frame, _ignored_range(radius_px, enlarged))
        others = scene[near]
        others = others[~others["crater_id"].isin(ids[rows])]
        ignored = unlabelled_craters(others, camera.intrinsics(), frame, radius_px, enlarged)
        shape = np.concatenate([shapes[rows], ignored[_SHAPE].to_numpy(np.float64)])
        labelled = np.arange(len(shape)) < len(rows)
        chosen = np.zeros(len(shape), np.bool_)
        chosen[: len(rows)] = wanted[rows]
        ratio = np.concatenate([depth_ratio[rows], np.full(len(ignored), np.nan)])
        parts.append(FrameLabels(shape[:, :4], shape[:, 4], shape[:, 5:], chosen, labelled, ratio))
    return DetectSplit(frames, parts, radius_px)


def _places(craters: pd.DataFrame) -> tuple[Array, Array]:
    """Centres (N, 3) and radii (N,) in metres."""
    return craters[["x_m", "y_m", "z_m"]].to_numpy(np.float64), craters["diameter_m"].to_numpy(np.float64) / 2


def _ignored_range(radius_px: tuple[float, float], enlarged: float) -> tuple[float, float]:
    return radius_px[0] * _MARGIN / enlarged, radius_px[1] / _MARGIN


def _right_size(
    points_m: Array, radius_m: Array, camera: Camera, frame: dict[Any, Any], range_px: tuple[float, float]
) -> NDArray[np.bool_]:
    """Craters (N,) before the camera whose radius in the frame may lie in a range, from their depth alone.

    Exact for level ground under a level camera; what a tilt changes stays well within the margins.
    """
    forward = matrix_from_quaternion(frame["rotation_wxyz"])[2]
    depth_m = points_m @ forward - np.asarray(frame["position_m"], np.float64) @ forward
    scaled = camera.fx_px * radius_m
    return (depth_m > 0) & (scaled > 0.8 * range_px[0] * depth_m) & (scaled < 2 * range_px[1] * depth_m)


def _labelled_range(dataset: Dataset) -> tuple[float, float]:
    """Least and largest radius of all labels of a dataset, pixels."""
    radius_px = dataset.table("labels", ["radius_px"]).to_pandas()["radius_px"]
    return float(radius_px.min()), float(radius_px.max())


def unlabelled_craters(
    craters: pd.DataFrame, camera: Camera, frame: dict[Any, Any], radius_px: tuple[float, float], enlarged: float = 1.0
) -> pd.DataFrame:
    """Craters of the scene that a frame shows just outside what is labelled, as rows to be ignored.

    A crater of 1.9 px looks like one of 2.1 px: with only the second in the table, half of what is labelled near the
    limit would be trained away as background, and finding the first would count as false. So, as COCO does with
    objects outside its area range, craters within a factor of sqrt(2) of the range (beyond that no box within the
    range overlaps them by half) and those whose centre is off the image are ignored; smaller ones too where frames
    will be `enlarged` by up to a factor. `frame` is a row of the table.
    """
    low, high = _ignored_range(radius_px, enlarged)
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
    rows["radius_px"], rows["wanted"], rows["labelled"] = shapes.radius_px(), False, False
    box = rows[_BOX].to_numpy(np.float64)
    seen = (box[:, 2:] > 0).all(1) & (box[:, :2] < [camera.width_px, camera.height_px]).all(1)
    return rows[seen & rows["radius_px"].between(low, high).to_numpy()]


def turn(image: NDArray, boxes: Array, kind: int) -> tuple[NDArray, Array]:
    """One of the eight symmetries of a frame (height, width) with its boxes (M, 4): bit 0 mirrors left and right,
    bit 1 top and bottom, bit 2 (applied last) exchanges x and y."""
    height, width = image.shape
    x0, y0, x1, y1 = boxes.T
    if kind & 1:
        image, x0, x1 = image[:, ::-1], width - x1, width - x0
    if kind & 2:
        image, y0, y1 = image[::-1], height - y1, height - y0
    if kind & 4:
        image, x0, y0, x1, y1 = image.T, y0, x0, y1, x1
    return image, np.stack([x0, y0, x1, y1], axis=1)


def rescale(image: NDArray, boxes: Array, factor: float, place: tuple[float, float]) -> tuple[NDArray, Array]:
    """A frame (height, width) and its boxes (M, 4), enlarged or shrunk to an image of the same size.

    `place` in [0, 1] tells, in x and y, which part of an enlarged frame is kept, or where a shrunk one lies; around
    that is the frame's mean grey.
    """
    height, width = image.shape
    shift = np.array([width, height]) * (1 - 1 / factor) * np.array(place)
    if factor < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / factor**2 - 1))
    # OpenCV counts from the middle of the first pixel, boxes from its edge.
    origin = shift + 0.5 / factor - 0.5
    matrix = np.array([[1 / factor, 0, origin[0]], [0, 1 / factor, origin[1]]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    scaled = cv2.warpAffine(image, matrix, (width, height), flags=how, borderValue=float(image.mean()))
    return scaled, (boxes - np.tile(shift, 2)) * factor


def grey_levels(image: NDArray[np.uint8], settings: AugmentSettings, rng: np.random.Generator) -> NDArray[np.float32]:
    """What each of the 256 grey levels of a frame becomes: stretched, brightened, bent, clipped at 255."""
    level = np.arange(256) / 255
    if settings.stretch:
        below = np.bincount(image.ravel(), minlength=256).cumsum() / image.size
        black, white = np.searchsorted(below, [rng.uniform(0, settings.stretch), 1 - rng.uniform(0, settings.stretch)])
        level = np.clip((np.arange(256) - black) / max(white - black, 1), 0, 1)
    gain = np.exp(rng.uniform(-1, 1) * np.log1p(settings.gain))
    gamma = np.exp(rng.uniform(-1, 1) * settings.gamma)
    return (255 * np.minimum(gain * level**gamma, 1)).astype(np.float32)


def augment(
    image: NDArray[np.uint8],
    boxes: Array,
    wanted: NDArray[np.bool_],
    radius_px: tuple[float, float],
    settings: AugmentSettings,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_]]:
    """A changed frame (height, width), grey levels as float32, its boxes (M, 4), and which of them are wanted (M,).

    A crater that rescaling moves out of the range `radius_px`, or its centre off the image, is wanted no more; one
    that becomes much smaller is left out.
    """
    turned: NDArray = image
    if settings.flips_and_turns:
        square = image.shape[0] == image.shape[1]
        turned, boxes = turn(image, boxes, int(rng.integers(8 if square else 4)))
    low, high = settings.scale
    if high > low:
        factor = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        turned, boxes = rescale(np.ascontiguousarray(turned), boxes, factor, (rng.random(), rng.random()))
        size = np.array(turned.shape[::-1])
        centre, radius = (boxes[:, :2] + boxes[:, 2:]) / 2, np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(1)) / 2
        seen = ((boxes[:, 2:] > 0) & (boxes[:, :2] < size)).all(1) & (radius >= radius_px[0] * _MARGIN)
        boxes, wanted, centre, radius = boxes[seen], wanted[seen], centre[seen], radius[seen]
        inside = ((centre >= 0) & (centre < size)).all(1)
        wanted = wanted & inside & (radius >= radius_px[0]) & (radius <= radius_px[1])
    pixels = grey_levels(turned, settings, rng)[turned]
    sigma_px = rng.uniform(0, settings.blur_px)
    if sigma_px > 0.3:
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma_px).astype(np.float32, copy=False)
    noise = rng.uniform(0, settings.noise)
    if noise > 0:
        pixels = pixels + np.float32(noise) * rng.standard_normal(pixels.shape, np.float32)
    return pixels, boxes, wanted


Batch = tuple[Tensor, Targets]


class TrainingFrames(torch_data.Dataset):
    """A split in the order and with the augmentation of one epoch, both a function of seed and epoch alone."""

    def __init__(self, split: DetectSplit, settings: AugmentSettings, seed: int, epoch: int):
        self.split, self.settings, self.key = split, settings, [seed, epoch]
        self.order = np.random.default_rng(self.key).permutation(len(split))

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, place: int) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_]]:
        index = int(self.order[place])
        labels = self.split.labels[index]
        rng = np.random.default_rng([*self.key, index])
        image, split = self.split.frames.images[index], self.split
        pixels, boxes, wanted = augment(image, labels.boxes, labels.wanted, split.radius_px, self.settings, rng)
        return normalised(pixels), boxes, wanted


class EvaluationFrames(torch_data.Dataset):
    """A split as it is, in order; of several `processes` each sees every n-th frame."""

    def __init__(self, split: DetectSplit, process: int = 0, processes: int = 1):
        self.split, self.own = split, range(process, len(split), processes)

    def __len__(self) -> int:
        return len(self.own)

    def __getitem__(self, place: int) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_]]:
        index = self.own[place]
        labels = self.split.labels[index]
        return normalised(self.split.frames.images[index]), labels.boxes, labels.wanted


def network_input(images: NDArray[np.float32] | Tensor, in_channels: int) -> Tensor:
    """Normalised frames (N, H, W) as the network takes them: (N, in_channels, H, W), channels last in memory."""
    stacked = torch.as_tensor(images)[:, None].expand(-1, in_channels, -1, -1)
    return stacked.contiguous(memory_format=torch.channels_last)


class Share(torch_data.Sampler[list[int]]):
    """The places in an epoch's order that one of `processes` takes, batch by batch.

    In every step the processes together take the next `size * processes` places, each an equal part, so that all
    have equally many batches and each place is taken once. Only of a last step with fewer places than processes
    nothing is taken (at most processes - 1 frames of an epoch, other ones in each).

    Iterates from batch `start` on; the length is that of the whole epoch.
    """

    def __init__(self, count: int, size: int, process: int = 0, processes: int = 1, start: int = 0):
        self.count, self.size, self.process, self.processes, self.start = count, size, process, processes, start

    def __len__(self) -> int:
        whole, rest = divmod(self.count, self.size * self.processes)
        return whole + (rest >= self.processes)

    def __iter__(self) -> Iterator[list[int]]:
        step = self.size * self.processes
        for first in range(self.start * step, len(self) * step, step):
            yield list(range(first, min(first + step, self.count)))[self.process :: self.processes]


def loader(
    frames: TrainingFrames | EvaluationFrames, config: DetectConfig, share: Share | None = None
) -> torch_data.DataLoader:
    """Batches (images (N, in_channels, H, W), Targets) in the given order; of a share where there is one."""

    def collate(samples: list) -> Batch:
        images, boxes, wanted = zip(*samples, strict=True)
        counts = torch.tensor([len(part) for part in boxes])
        return network_input(np.stack(images), config.in_channels), Targets(
            torch.as_tensor(np.concatenate(boxes), dtype=torch.float32),
            torch.repeat_interleave(torch.arange(len(samples)), counts),
            torch.as_tensor(np.concatenate(wanted)),
        )

    batches = share or Share(len(frames), config.batch_size)
    return torch_data.DataLoader(frames, batch_sampler=batches, num_workers=config.workers, collate_fn=collate)
