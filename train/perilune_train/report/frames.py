"""Frames with labels and detections, and the descent with attention masks that the viewer shows."""

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.errors import UserError
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import FALSE, FOUND, Detections, Matches, find_overlaps
from perilune_train.report.content import FramePicture, Mark, MaskStack, Provenance, Viewer
from perilune_train.report.pictures import image_uri, png_uri

MASKS_FILE = "masks_detect.npz"
_MATCH_IOU = 0.5
_MAX_FRAMES = 60
_MAX_SIDE_PX = 512
_MAX_MASKS_BYTES = 2**28
_KINDS = {FOUND: "matched", FALSE: "false"}


@dataclass(frozen=True)
class LabelledFrames:
    """The test frames of a dataset with labels and, if there is a run, the run's detections."""

    split: DetectSplit
    """Frames and labels."""
    found: list[Detections]
    """Detections above the threshold, one entry per frame; all entries are empty without a run."""
    matches: Matches
    """Detections matched at IoU 0.5."""
    first_label: NDArray[np.intp]
    """Index (N,) of each frame's first label in `matches`, which numbers the labels of all frames consecutively."""
    has_detections: bool
    """Whether the detections come from a run; False if there is no run."""
    provenance: Provenance
    """Provenance of the run, or of the dataset if there is no run."""
    are_probabilities: bool = False
    """Whether the scores are calibrated."""

    def f1(self) -> NDArray[np.float64]:
        """F1 of each frame (N,) at the run's threshold; NaN for frames without selected labels."""
        count = len(self.split)
        hits, false = (np.bincount(self.matches.frame[self.matches.outcome == k], minlength=count) for k in _KINDS)
        labels = np.bincount(self.matches.selected_frame, minlength=count)
        return np.divide(2 * hits, hits + false + labels, out=np.full(count, np.nan), where=labels > 0)

    def picture(self, index: int, first_words: str = "") -> FramePicture:
        """One frame with the marks of its labels and detections. The caption begins with `first_words`."""
        frame_labels = self.split.labels[index]
        rows = np.flatnonzero(self.matches.frame == index)
        missed = frame_labels.selected.copy()
        hit = self.matches.label[rows]
        missed[hit[hit >= 0] - self.first_label[index]] = False
        labels = []
        for (cx, cy, a, b, theta), selected, lost in zip(
            frame_labels.ellipses, frame_labels.selected, missed, strict=True
        ):
            kind = "ignored" if not selected else "missed" if lost and self.has_detections else "found"
            labels.append(Mark(kind, (_px(cx), _px(cy), _px(a), _px(b), _px(np.degrees(theta)))))
        labels = [mark for mark, labelled in zip(labels, frame_labels.labelled, strict=True) if labelled]
        detections = []
        # The matches of a frame have the order of its detections.
        found = self.found[index]
        for k, ((x0, y0, x1, y1), score, outcome) in enumerate(
            zip(found.boxes, found.scores, self.matches.outcome[rows], strict=True)
        ):
            shape = (_px(x0), _px(y0), _px(x1 - x0), _px(y1 - y0), round(float(score), 3))
            ellipse = () if found.shapes is None else _ellipse(found.ellipses[k], found.shapes[k])
            detections.append(Mark(_KINDS.get(int(outcome), "unjudged"), shape, ellipse))
        image = self.split.frames.images[index]
        height, width = image.shape
        return FramePicture(
            self.split.frames.table["frame_id"][index],
            frame_uri(image),
            width,
            height,
            first_words + self._about(index, int(frame_labels.selected.sum())),
            tuple(labels),
            tuple(detections),
            (self.provenance,),
        )

    def _about(self, index: int, n_labels: int) -> str:
        facts = facts_of(self.split.frames)
        text = f"{facts.altitude_m[index]:.0f} m, Sun {facts.sun_elevation_deg[index]:.0f}°, {n_labels} labels"
        if not self.has_detections:
            return text
        outcome = self.matches.outcome[self.matches.frame == index]
        return text + f", {np.sum(outcome == FOUND)} found, {np.sum(outcome == FALSE)} false"

    def craters_of(self, index: int) -> list[int | None]:
        """The crater_id of the label of each detection of a frame; None without a label or without ids."""
        ids, labels = self.split.labels[index].crater_id, self.matches.label[self.matches.frame == index]
        own = [int(label - self.first_label[index]) if label >= 0 else None for label in labels]
        return [None if label is None or ids is None or ids[label] < 0 else int(ids[label]) for label in own]

    def indices_of(self, trajectory: str) -> list[int]:
        """Indices of the frames of one trajectory (scene_id/trajectory_id), in order."""
        return [index for index, name in enumerate(facts_of(self.split.frames).trajectory) if name == trajectory]

    def trajectories(self) -> list[str]:
        """Names of the trajectories (scene_id/trajectory_id), in order."""
        return list(dict.fromkeys(facts_of(self.split.frames).trajectory))


def labelled_frames(
    split: DetectSplit,
    detected: list[Detections] | None,
    provenance: Provenance,
    are_probabilities: bool = False,
) -> LabelledFrames:
    """Match the labels of a split to a run's detections above the threshold; `detected` is None without a run."""
    nothing = Detections(np.empty((0, 4)), np.empty(0))
    detections = [nothing] * len(split) if detected is None else detected
    height, width = split.frames.images.shape[1:]
    overlaps = find_overlaps(detections, list(split.labels), np.tile([width, height], (len(split), 1)))
    matches = overlaps.match(_MATCH_IOU, split.radius_px)
    first = np.searchsorted(overlaps.label_frame, np.arange(len(split)))
    # Order each frame's detections by score, as in the matches.
    ordered = [_best_first(of_frame) for of_frame in detections]
    return LabelledFrames(split, ordered, matches, first, detected is not None, provenance, are_probabilities)


def frame_uri(image: NDArray[np.uint8]) -> str:
    """A frame as a data URI: a lossless PNG up to 512 px; larger frames are reduced to 512 px, as WebP."""
    if max(image.shape) <= _MAX_SIDE_PX:
        return picture_uri(Image.fromarray(image))
    picture = Image.fromarray(image)
    picture.thumbnail((_MAX_SIDE_PX, _MAX_SIDE_PX))
    return image_uri(picture)


def viewer_of(frames: LabelledFrames, masks: Path | None, mask_provenance: Provenance | None) -> Viewer:
    """The descent that the viewer shows, with at most 60 frames.

    This is the descent in the file `masks`; if `masks` is None, it is the first test trajectory. Raises UserError if
    the file is damaged or does not begin with a test frame of the dataset.
    """
    names = frames.split.frames.table["frame_id"].tolist()
    content = None if masks is None else read_masks(masks)
    if content is None:
        trajectory = frames.trajectories()[0]
    else:
        first = str(content["frame_ids"][0])
        if first not in names:
            raise UserError(masks, "frame_ids", first, "a test frame of the detection dataset")
        trajectory = facts_of(frames.split.frames).trajectory[names.index(first)]
    indices = frames.indices_of(trajectory)
    if len(indices) > _MAX_FRAMES:
        indices = [indices[k] for k in np.linspace(0, len(indices) - 1, _MAX_FRAMES).astype(int)]
    chosen = [names[index] for index in indices]
    stacks = () if content is None else tuple(_stacks(content, chosen))
    sources = [frames.provenance, *([mask_provenance] if stacks and mask_provenance else [])]
    return Viewer(trajectory, tuple(frames.picture(index) for index in indices), stacks, tuple(sources))


def read_masks(path: Path) -> dict[str, NDArray[Any]]:
    """Read a file of masks, as written by `explain.maps.masks.save_masks`: all arrays by name.

    The arrays are frame_ids (N,), blocks (B,), finite low and high (B,), and uint8 (N, h, w) for each block. A block is
    the name of a gate, such as B_11.

    Raises UserError if an array is missing or has another shape, type or range, or if the file is damaged or too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
        if size > _MAX_MASKS_BYTES:
            raise UserError(path, "size", f"{size} bytes", f"at most {_MAX_MASKS_BYTES} bytes")
        with np.load(path, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise UserError(path, "masks", error, "arrays of NumPy, without pickled objects") from None
    missing = {"frame_ids", "blocks", "low", "high"} - content.keys()
    if missing:
        raise UserError(path, min(missing), "nothing", "an array")
    count, blocks = len(np.atleast_1d(content["frame_ids"])), np.atleast_1d(content["blocks"])
    if not count:
        raise UserError(path, "frame_ids", "no frames", "the frames of one trajectory")
    for name in ("low", "high"):
        if content[name].shape != blocks.shape or content[name].dtype.kind != "f":
            raise UserError(path, name, f"{content[name].dtype} {content[name].shape}", f"floats {blocks.shape}")
        unusable = content[name][~np.isfinite(content[name])]
        if len(unusable):
            raise UserError(path, name, unusable[0], "finite numbers")
    for block in blocks:
        array = content.get(str(block))
        if array is None or array.dtype != np.uint8 or array.ndim != 3 or len(array) != count or 0 in array.shape:
            got = "nothing" if array is None else f"{array.dtype} {array.shape}"
            raise UserError(path, str(block), got, f"uint8 ({count}, height, width)")
    return content


def _stacks(content: dict[str, NDArray[Any]], names: Sequence[str]) -> list[MaskStack]:
    index_of = {str(name): index for index, name in enumerate(np.atleast_1d(content["frame_ids"]))}
    colours = (matplotlib.colormaps["cividis"](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    stacks = []
    for number, block in enumerate(np.atleast_1d(content["blocks"])):
        images = []
        for name in names:
            index = index_of.get(name)
            if index is None:
                images.append("")
                continue
            picture = Image.fromarray(content[str(block)][index]).convert("P")
            picture.putpalette(colours.tobytes())
            images.append(picture_uri(picture))
        low, high = (float(content[key][number]) for key in ("low", "high"))
        stacks.append(MaskStack(str(block), low, high, tuple(images)))
    return stacks


def _best_first(detections: Detections) -> Detections:
    order = np.argsort(-detections.scores, kind="stable")
    return detections.take(order)


def picture_uri(picture: Image.Image) -> str:
    """A picture as a data URI, lossless."""
    stream = io.BytesIO()
    picture.save(stream, "PNG", optimize=True)
    return png_uri(stream.getvalue())


def _px(value: float) -> float:
    return round(float(value), 2)


def _ellipse(ellipse: NDArray[np.float64], shape: NDArray[np.float64]) -> tuple[float, ...]:
    """The values of `Mark.ellipse` from rows of `Detections.ellipses` and `Detections.shapes`."""
    semi_major, semi_minor, theta = ellipse[2:]
    return (_px(semi_major), _px(semi_minor), _px(np.degrees(theta)), *(round(float(sigma), 3) for sigma in shape[1:]))
