"""LabelMe: a JSON file per image, with rectangles, polygons, circles and masks."""

import math
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import Box, around, size_of
from perilune_train.detect.images.labels.image_set import Entry, LabelledObject
from perilune_train.detect.images.labels.texts import read_json

_EXPECTED = "a file of LabelMe"
_WITHOUT_AREA = ("point", "points", "line", "linestrip")


def read_labelme(path: Path, picture: Path, name: str) -> tuple[Entry, int]:
    """Read the objects of one file; returns the entry and the number of omitted shapes without area."""
    content = read_json(path, _EXPECTED, _without_pixels)
    shapes = content.get("shapes") if isinstance(content, dict) else None
    if not isinstance(shapes, list) or not all(isinstance(shape, dict) for shape in shapes):
        raise UserError(path, "shapes", type(shapes).__name__, "a list of shapes, as in LabelMe")
    objects = []
    for k, shape in enumerate(shapes):
        if shape.get("shape_type") not in _WITHOUT_AREA:
            box = _box(shape, path, f"shapes[{k}].points")
            objects.append(LabelledObject(box, " ".join(str(shape.get("label", "")).split())))
    size = size_of(content.get("imageWidth"), content.get("imageHeight"), path, "imageWidth and imageHeight")
    return Entry(name, picture, objects, path, size), len(shapes) - len(objects)


def _without_pixels(record: dict) -> dict:
    record.pop("imageData", None)
    return record


def _box(shape: dict[str, Any], path: Path, field: str) -> Box:
    points = shape.get("points")
    box = around(points if isinstance(points, list) else [], path, field)
    if shape.get("shape_type") == "circle":
        # A circle is stored as its centre and a point on it.
        if not isinstance(points, list) or len(points) != 2:
            raise UserError(path, field, points, "the centre of a circle and a point on it")
        (x, y), (edge_x, edge_y) = ((float(p[0]), float(p[1])) for p in points)
        radius = math.hypot(edge_x - x, edge_y - y)
        return x - radius, y - radius, x + radius, y + radius
    return box
