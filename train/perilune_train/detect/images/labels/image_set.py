"""Labelled images, and their construction from the objects of a label file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import Box, StatedSize
from perilune_train.detect.images.pictures import check_names
from perilune_train.detect.images.read import picture_size, stored_size

Array = NDArray[np.float64]
_CRATER_NAMES = ("crater", "craters")


@dataclass(frozen=True)
class LabelledImage:
    """One image and its labels; the pixels stay in the file."""

    name: str
    """Path within the folder, used as the name in tables and pictures."""
    path: Path
    """The image file."""
    width_px: int
    """Width, pixels."""
    height_px: int
    """Height, pixels."""
    boxes: Array
    """x0, y0, x1, y1 in pixels (M, 4). Boxes may extend beyond the image unless the set is clipped."""
    not_ignored: NDArray[np.bool_]
    """False for a box that the label file marks as ignored or as a crowd (M,)."""
    crowd: NDArray[np.bool_] | None = None
    """Whether a box is a region of many craters (M,), COCO's `iscrowd`; None if no box is a crowd."""

    @property
    def sizes_px(self) -> Array:
        """Size of each crater, sqrt(w h), pixels (M,): the side of the square of equal area."""
        return np.sqrt(np.prod(self.boxes[:, 2:] - self.boxes[:, :2], axis=1))

    def selected(self, min_size_px: float) -> NDArray[np.bool_]:
        """Whether each box is ground truth (M,): not ignored, centred in the image, large enough."""
        centre = (self.boxes[:, :2] + self.boxes[:, 2:]) / 2
        inside = ((centre >= 0) & (centre < [self.width_px, self.height_px])).all(axis=1)
        return self.not_ignored & inside & (self.sizes_px >= min_size_px)


@dataclass(frozen=True)
class ImageSet:
    """All labelled images of a folder or a label file."""

    images: list[LabelledImage]
    """Images, sorted by name or in the order of the file."""
    clipped: bool
    """Whether boxes are clipped at the image's edge, so that detections must be clipped before matching."""
    categories: str = ""
    """Text that names the categories taken as craters; "" if there are no other categories than crater."""
    split: str = ""
    """Text that names the split; "" if the source has no splits."""


@dataclass(frozen=True)
class LabelledObject:
    """One object of a label file."""

    box: Box
    """x0, y0, x1, y1, pixels."""
    category: str = ""
    """Id of the object's category, a key of `LabelFile.categories`."""
    ignored: bool = False
    """Whether the source marks the object as ignored (`ignore`, `difficult`)."""
    crowd: bool = False
    """Whether the object is a region of many objects (`iscrowd`)."""


@dataclass(frozen=True)
class Entry:
    """A picture and its objects, as a label file gives them."""

    name: str
    """Name in tables."""
    path: Path
    """The picture."""
    objects: list[LabelledObject]
    """All objects, of every category."""
    labels: Path
    """The label file, named in messages."""
    size_px: StatedSize = (None, None)
    """Width and height that the file states."""


@dataclass(frozen=True)
class LabelFile:
    """Content of a label file, or of a folder of label files, in any format."""

    source: Path
    """Path of the file or folder, named in messages."""
    entries: list[Entry]
    """Pictures and their objects."""
    categories: Mapping[str, str] = field(default_factory=dict)
    """Name of each category, by its id in the file."""
    clip: bool = True
    """Whether to clip boxes at the edges of the picture."""
    notes: tuple[str, ...] = ()
    """Messages for the user."""


def image_set(label_file: LabelFile, wanted: Sequence[str] = ()) -> ImageSet:
    """Check the pictures, select the objects that are craters, and clip their boxes.

    `wanted` are the names of the crater categories (`choose_categories`). Raises UserError if a picture cannot be read,
    occurs twice or has another size than the label file states, or if no category is a crater.
    """
    chosen, text = choose_categories(label_file.categories, wanted, label_file.source)
    check_names([entry.path for entry in label_file.entries], [entry.name for entry in label_file.entries])
    check_names(
        [entry.path for entry in label_file.entries], [str(entry.path.resolve()) for entry in label_file.entries]
    )
    images, n_empty = [], 0
    for entry in label_file.entries:
        size = picture_size(entry.path)
        if any(stated not in (None, side) for stated, side in zip(entry.size_px, size, strict=True)):
            raise _other_size(entry, size)
        craters = [item for item in entry.objects if chosen is None or item.category in chosen]
        boxes = np.array([item.box for item in craters], np.float64).reshape(-1, 4)
        if label_file.clip:
            boxes = np.clip(boxes, 0, np.tile(size, 2))
        kept = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        n_empty += int((~kept).sum())
        crowd = np.array([item.crowd for item in craters], bool)[kept]
        not_ignored = ~np.array([item.ignored or item.crowd for item in craters], bool)[kept]
        images.append(LabelledImage(entry.name, entry.path, *size, boxes[kept], not_ignored, crowd))
    left_out = f"{n_empty} boxes without width or height in the picture are left out"
    for note in (*label_file.notes, *[left_out] * bool(n_empty), *[text] * bool(text)):
        say(f"{label_file.source.name}: {note}")
    return ImageSet(images, label_file.clip, text)


def choose_categories(
    categories: Mapping[str, str], wanted: Sequence[str], source: Path
) -> tuple[set[str] | None, str]:
    """The ids of the categories that are craters, and a text that names the categories.

    `wanted` are the names of the crater categories. Without `wanted`, the categories named crater or craters, in upper
    or lower case, are chosen. There may be several, because Roboflow adds a placeholder category to its exports.
    Without `wanted` and with fewer than two categories, every object is a crater, and the ids are None.
    """
    names = {key: " ".join(name.split()) for key, name in categories.items()}
    asked = [name.strip().lower() for name in wanted]
    if not asked and len(names) < 2:
        odd = [name for name in names.values() if name.lower() not in (*_CRATER_NAMES, "")]
        return None, "".join(f"every object is taken as a crater; their category is {name}" for name in odd)
    # Formats without category ids, such as Pascal VOC, use the name as the id.
    described = {key: name if name == key else f"{name} ({key})" for key, name in names.items()}
    known = ", ".join(names.values())
    for name, original in zip(asked, wanted, strict=True):
        if name not in {key.lower() for key in names} | {other.lower() for other in names.values()}:
            raise UserError("--category", "", original, f"one of {known}" if names else "a category of the labels")
    among = asked or _CRATER_NAMES
    chosen = {key for key, name in names.items() if name.lower() in among or key.lower() in asked}
    if not chosen:
        raise UserError(source, "categories", known, "one named crater or craters, or --category NAME")
    others = ", ".join(described[key] if asked else names[key] for key in names if key not in chosen)
    taken = ", ".join(described[key] for key in names if key in chosen)
    return chosen, f"categories taken as craters: {taken}" + (f"; left out: {others}" if others else "")


def _other_size(entry: Entry, size: tuple[int, int]) -> UserError:
    width, height = (stated or side for stated, side in zip(entry.size_px, size, strict=True))
    expected = f"{width} x {height}, as stated in {entry.labels.name}"
    if (height, width) == size and stored_size(entry.path) == (width, height):
        expected += "; the picture's EXIF orientation turns it, and labels must refer to the upright picture"
    return UserError(entry.path, "size", f"{size[0]} x {size[1]}", expected)
