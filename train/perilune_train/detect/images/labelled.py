"""Labelled images from other sources: a folder of images with tables of boxes, or COCO.

A table (`<name>.txt` beside `<name>.png`) has a header with X, Y, W and H: left, top, width and height of a box in
pixels, separated by commas or tabs. COCO is read from annotations.json in the folder, or from a given file. Its images
are searched in the file's folder, ../images, ../images/NAME and ../NAME, where NAME is the last part of the file's name
(train2017 for instances_train2017.json). Coordinates are assumed to begin at the outer corner of the top-left pixel.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.terminal import console
from perilune_train.detect.images.read import SUFFIXES, picture_size, stored_size

Array = NDArray[np.float64]
_COLUMNS = ("X", "Y", "W", "H")
_CRATER_NAMES = ("crater", "craters")
_LARGEST_PX = 1e6


@dataclass(frozen=True)
class LabelledImage:
    """One image and its labels; the pixels stay in the file."""

    name: str
    """Path within the folder, for tables and pictures."""
    path: Path
    """The image file."""
    width_px: int
    """Width, pixels."""
    height_px: int
    """Height, pixels."""
    boxes: Array
    """x0, y0, x1, y1 in pixels (M, 4); they may extend beyond the image."""
    not_ignored: NDArray[np.bool_]
    """False for a box that its source marks as ignored (M,)."""

    @property
    def sizes_px(self) -> Array:
        """Side of the square of equal area, sqrt(w h), pixels (M,): the size of a crater here."""
        return np.sqrt(np.prod(self.boxes[:, 2:] - self.boxes[:, :2], axis=1))

    def selected(self, min_size_px: float) -> NDArray[np.bool_]:
        """Which boxes are ground truth (M,): not ignored, centred in the image, and of at least this size."""
        centre = (self.boxes[:, :2] + self.boxes[:, 2:]) / 2
        inside = ((centre >= 0) & (centre < [self.width_px, self.height_px])).all(axis=1)
        return self.not_ignored & inside & (self.sizes_px >= min_size_px)


@dataclass(frozen=True)
class ImageSet:
    """All labelled images of a folder or a COCO file."""

    images: list[LabelledImage]
    """Sorted by name, or in the order of the COCO file."""
    clipped: bool
    """Whether boxes are clipped at the image's edge (as in COCO), so that detections must be clipped before
    matching."""
    categories: str = ""
    """Text that names the categories of a COCO file taken as craters; "" if there was no choice."""


def read_images(source: Path) -> ImageSet:
    """Read the labelled images of a folder or a COCO file. Raises UserError, naming file and line, on invalid input."""
    if source.is_file():
        return _read_coco(source)
    if not source.is_dir():
        raise UserError(source, "--images", "no such folder", "a folder of images with boxes, or a COCO file")
    if (source / "annotations.json").is_file():
        return _read_coco(source / "annotations.json")
    paths = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise UserError(source, "--images", "no PNG, TIFF or JPEG", "images with boxes beside them")
    images = []
    for path in paths:
        boxes = read_table(path.with_suffix(".txt"))
        images.append(LabelledImage(path.name, path, *picture_size(path), boxes, np.ones(len(boxes), bool)))
    return ImageSet(images, clipped=False)


def read_table(path: Path) -> Array:
    """Boxes (M, 4) of a table with a header. Raises UserError on an invalid row."""
    rows = _lines(path)
    header = next(rows, (1, ""))[1]
    separator = "\t" if "\t" in header else ","
    names = [name.strip().upper() for name in header.split(separator)]
    for column in _COLUMNS:
        if column not in names:
            raise UserError(path, "line 1", header or "no header", f"a column {column}, as in ID,X,Y,W,H,C_X,CY")
    places = [names.index(column) for column in _COLUMNS]
    boxes = []
    for number, line in rows:
        cells = line.split(separator)
        if len(cells) != len(names):
            raise UserError(path, f"line {number}", f"{len(cells)} values", f"{len(names)}, as in the header")
        boxes.append(_box([cells[place] for place in places], path, f"line {number}"))
    return np.array(boxes, np.float64).reshape(-1, 4)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are not empty, numbered from 1."""
    if not path.is_file():
        raise UserError(path, "boxes", "no such file", "a text file of boxes (ID,X,Y,W,H,C_X,CY) beside each image")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(path, "boxes", "bytes that are not UTF-8 text", "rows of ID,X,Y,W,H,C_X,CY") from None
    return ((n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip())


def _box(values: Any, path: Path, field: str, may_be_empty: bool = False) -> tuple[float, float, float, float]:
    """A box from left, top, width and height."""
    try:
        x, y, w, h = (float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise UserError(path, field, values, "four numbers: left, top, width, height") from None
    shorter = min(w, h)
    if not all(math.isfinite(v) and abs(v) <= _LARGEST_PX for v in (x, y, w, h)) or not (
        shorter > 0 or (may_be_empty and shorter == 0)
    ):
        raise UserError(path, field, values, f"a width and height above 0, and no number beyond {_LARGEST_PX:.0f} px")
    return x, y, x + w, y + h


def _read_coco(path: Path) -> ImageSet:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise UserError(path, "JSON", error, "a COCO file") from None
    if not isinstance(content, dict):
        raise UserError(path, "JSON", type(content).__name__, "an object with images and annotations")
    craters, chosen = _crater_categories(_records(content, "categories", path), path)
    images = _records(content, "images", path)
    row_of = {_identity(image, "id", f"images[{k}]", path): k for k, image in enumerate(images)}
    if not images or len(row_of) < len(images):
        raise UserError(path, "images", "none" if not images else "duplicate ids", "images with an id each")
    boxes: list[list] = [[] for _ in images]
    not_ignored: list[list[bool]] = [[] for _ in images]
    n_empty = 0
    for n, annotation in enumerate(_records(content, "annotations", path)):
        field = f"annotations[{n}]"
        if craters is not None and annotation.get("category_id") not in craters:
            continue
        row = row_of.get(_identity(annotation, "image_id", field, path))
        if row is None:
            raise UserError(path, f"{field}.image_id", annotation["image_id"], "the id of one of the images")
        box = _box(annotation.get("bbox"), path, f"{field}.bbox", may_be_empty=True)
        if box[0] == box[2] or box[1] == box[3]:
            n_empty += 1
            continue
        boxes[row].append(box)
        not_ignored[row].append(not annotation.get("iscrowd") and not annotation.get("ignore"))
    result = []
    for k, image in enumerate(images):
        picture = _picture(path, image.get("file_name"), f"images[{k}].file_name")
        size = picture_size(picture)
        stated = image.get("width", size[0]), image.get("height", size[1])
        if stated != size:
            raise _other_size(picture, size, stated, path)
        own = np.array(boxes[k], np.float64).reshape(-1, 4)
        result.append(LabelledImage(image["file_name"], picture, *size, own, np.array(not_ignored[k], bool)))
    if n_empty:
        console.print(f"{path.name}: {n_empty} boxes without width or height are left out", markup=False)
    if chosen:
        console.print(f"{path.name}: {chosen}", markup=False)
    return ImageSet(result, clipped=True, categories=chosen)


def _other_size(picture: Path, size: tuple[int, int], stated: tuple[int, int], labels: Path) -> UserError:
    expected = f"{stated[0]} x {stated[1]}, as stated in {labels.name}"
    if stated == size[::-1] == stored_size(picture):
        expected += "; the picture's EXIF orientation turns it, and labels must be those of the upright picture"
    return UserError(picture, "size", f"{size[0]} x {size[1]}", expected)


def _records(content: dict[str, Any], name: str, path: Path) -> list[dict[str, Any]]:
    """A list of objects; a missing list of categories counts as an empty one."""
    found = content.get(name, [] if name == "categories" else None)
    if not isinstance(found, list) or not all(isinstance(record, dict) for record in found):
        raise UserError(path, name, type(found).__name__, "a list of objects, as in COCO")
    return found


def _identity(record: dict[str, Any], name: str, field: str, path: Path) -> int | str:
    value = record.get(name)
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise UserError(path, f"{field}.{name}", value, "a number or a name")
    return value


def _crater_categories(categories: list[dict[str, Any]], path: Path) -> tuple[list[int | str] | None, str]:
    """The ids of all categories named crater or craters, in upper or lower case, and a text that names them.

    There may be several, since exports of Roboflow also have a placeholder category. With fewer than two categories in
    the file every object is a crater: None and "".
    """
    if len(categories) < 2:
        return None, ""
    craters = [one for one in categories if str(one.get("name", "")).strip().lower() in _CRATER_NAMES]
    names = [str(one.get("name")) for one in categories]
    if not craters:
        raise UserError(path, "categories", ", ".join(names), "one category, or one named crater or craters")
    ids = [_identity(one, "id", "categories", path) for one in craters]
    taken = ", ".join(f"{one.get('name')} ({number})" for one, number in zip(craters, ids, strict=True))
    others = ", ".join(str(one.get("name")) for one in categories if one not in craters)
    return ids, f"categories taken as craters: {taken}" + (f"; left out: {others}" if others else "")


def _picture(path: Path, name: Any, field: str) -> Path:
    """Path of the image that a COCO file names, in the first possible folder that contains it."""
    root = path.resolve().parent
    ending = path.stem.rpartition("_")[2]
    images = root.parent / "images"
    for folder in (root, images, images / ending, root.parent / ending):
        picture = _below(folder, name, path, field)
        if picture.is_file():
            return picture
    return _below(root, name, path, field)


def _below(folder: Path, name: Any, path: Path, field: str) -> Path:
    """A path in a folder or below it. Raises UserError on a path that leads outside."""
    if isinstance(name, str) and name and "\0" not in name:
        try:
            picture = folder.joinpath(name).resolve()
        except (OSError, RuntimeError):  # circular links
            picture = folder
        if picture != folder and picture.is_relative_to(folder):
            return picture
    raise UserError(path, field, name, "a path of an image below the COCO file's folder, or below images next to it")
