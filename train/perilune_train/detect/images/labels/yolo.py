"""YOLO labels: one text file per image, one line `class cx cy w h` per object.

Coordinates are fractions of the image size. A line with a polygon (`class x1 y1 x2 y2 ...`) becomes the box around the
polygon. In a line of six numbers, the last number (a score) is ignored. Numbers are separated by spaces, tabs or
commas. An empty file means an image without objects.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from perilune_shared.config.yaml_text import parse_yaml
from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import around
from perilune_train.detect.images.labels.image_set import LabelledObject
from perilune_train.detect.images.labels.texts import below, read_text
from perilune_train.detect.images.pictures import is_picture, pictures_of
from perilune_train.detect.images.read import picture_size

SPLIT_KEYS = {"train": ("train",), "val": ("val", "valid", "validation"), "test": ("test",)}
_FRACTIONS = -1.0, 2.0
"""Range of accepted fractions. Boxes may extend beyond the image, but larger values are probably pixels."""
_LISTED_SUFFIX = ".txt"


def is_yolo(text: str) -> bool:
    """Whether the text of a label file is YOLO: empty, or with only numbers in the first line."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    try:
        return all(float(cell) is not None for cell in _cells(first))
    except ValueError:
        return False


def read_yolo_text(path: Path, picture: Path) -> list[LabelledObject]:
    """The objects of one text file; their categories are the class numbers."""
    width, height = picture_size(picture)
    objects = []
    for number, line in enumerate(read_text(path, "labels").splitlines(), 1):
        cells = _cells(line)
        if not cells:
            continue
        field = f"line {number}"
        try:
            category, values = int(float(cells[0])), [float(cell) for cell in cells[1:]]
        except (ValueError, OverflowError):
            raise UserError(path, field, line.strip(), "numbers: class, centre x and y, width, height") from None
        if not (len(values) in (4, 5) or (len(values) >= 6 and len(values) % 2 == 0)):
            expected = "class, centre x and y, width, height, or class and the corners of a polygon"
            raise UserError(path, field, f"{len(cells)} values", expected)
        if not all(_FRACTIONS[0] <= value <= _FRACTIONS[1] for value in values):
            raise UserError(path, field, line.strip(), "fractions of the image's width and height, from 0 to 1")
        if len(values) in (4, 5):
            x, y, w, h = values[:4]
            if min(w, h) < 0:
                raise UserError(path, field, line.strip(), "a width and height of at least 0")
            values = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
        points = [(x * width, y * height) for x, y in zip(values[::2], values[1::2], strict=True)]
        objects.append(LabelledObject(around(points, path, field), str(category)))
    return objects


def label_of(picture: Path) -> Path:
    """Path of a picture's label file: labels/a/b.txt for images/a/b.png, else beside the picture."""
    parts = list(picture.parts)
    for level in range(len(parts) - 2, -1, -1):
        if parts[level].lower() == "images":
            parts[level] = "labels"
            return Path(*parts).with_suffix(_LISTED_SUFFIX)
    return picture.with_suffix(_LISTED_SUFFIX)


def read_data_yaml(path: Path) -> dict[str, Any]:
    """The content of a data.yaml. Raises UserError on invalid YAML."""
    content = parse_yaml(read_text(path, "YAML"), path)
    if not isinstance(content, dict):
        raise UserError(path, "YAML", type(content).__name__, "train, val or test, and names")
    return content


def class_names(content: Mapping[str, Any]) -> dict[str, str]:
    """Names of the classes, by number; {} without names."""
    names = content.get("names")
    pairs = names.items() if isinstance(names, dict) else enumerate(names) if isinstance(names, list) else ()
    return {str(number): str(name) for number, name in pairs}


def pictures_of_split(path: Path, value: Any) -> list[Path]:
    """The pictures of a split of a data.yaml.

    `value` has the split's folders or lists of paths, which must be below the folder of data.yaml.
    """
    root = path.resolve().parent
    images = []
    for name in value if isinstance(value, list) else [value]:
        # Roboflow writes ../test/images for a folder beside the file.
        pictures = below(root, name.removeprefix("../") if isinstance(name, str) else name, path, "split")
        if pictures.is_dir():
            images += pictures_of(pictures, recursive=True)
        elif pictures.suffix == _LISTED_SUFFIX:
            images += listed_pictures(pictures)
        else:
            raise UserError(path, "split", name, "a folder of images, or a list of their paths (.txt)")
    return images


def listed_pictures(path: Path) -> list[Path]:
    """The pictures that a list names: one path per line, relative to the folder of the list."""
    root = path.resolve().parent
    lines = enumerate(read_text(path, "list").splitlines(), 1)
    images = [below(root, line.strip(), path, f"line {n}") for n, line in lines if line.strip()]
    for picture in images:
        if not is_picture(picture):
            raise UserError(path, "list", picture.name, "paths of images")
    return images


def _cells(line: str) -> list[str]:
    return line.replace(",", " ").split()
