"""COCO: one JSON file with images, annotations and categories."""

from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import Box, around, box_of, size_of
from perilune_train.detect.images.labels.image_set import Entry, LabelFile, LabelledObject
from perilune_train.detect.images.labels.texts import find_picture, read_json

_EXPECTED = "a COCO file"


def is_coco(content: Any) -> bool:
    """Whether the content of a JSON file has COCO's format."""
    return isinstance(content, dict) and "images" in content and "annotations" in content


def read_content(path: Path) -> dict[str, Any]:
    """The content of a COCO file, without the polygons of objects that have a box. May raise UserError."""
    content = read_json(path, _EXPECTED, _without_polygon)
    if not isinstance(content, dict):
        raise UserError(path, "JSON", type(content).__name__, "an object with images and annotations")
    return content


def read_coco(path: Path, content: dict[str, Any], image_folder: Path | None = None) -> LabelFile:
    """Convert the content of a COCO file. Raises UserError, which names file and field, if it is invalid."""
    categories = {
        _id_of(category_record, "id", "categories", path): str(category_record.get("name", ""))
        for category_record in _records(content, "categories", path)
    }
    images = _records(content, "images", path)
    row_of = {_id_of(image, "id", f"images[{k}]", path): k for k, image in enumerate(images)}
    if not images or len(row_of) < len(images):
        raise UserError(path, "images", "none" if not images else "duplicate ids", "images with distinct ids")
    objects: list[list[LabelledObject]] = [[] for _ in images]
    for n, annotation in enumerate(_records(content, "annotations", path)):
        field = f"annotations[{n}]"
        row = row_of.get(_id_of(annotation, "image_id", field, path))
        if row is None:
            raise UserError(path, f"{field}.image_id", annotation["image_id"], "the id of one of the images")
        category = _id_text(annotation.get("category_id")) or ""
        ignored, crowd = _flag(annotation.get("ignore")), _flag(annotation.get("iscrowd"))
        objects[row].append(LabelledObject(_box(annotation, path, field), category, ignored, crowd))
    entries = []
    for k, image in enumerate(images):
        field = f"images[{k}]"
        picture = find_picture(path, image.get("file_name"), f"{field}.file_name", image_folder)
        stated = size_of(image.get("width"), image.get("height"), path, f"{field}.width and height")
        entries.append(Entry(image["file_name"], picture, objects[k], path, stated))
    return LabelFile(path, entries, categories)


def _without_polygon(record: dict) -> dict:
    """Drop the polygons of an object that has a box, because polygons take most of the memory."""
    if record.get("bbox"):
        record.pop("segmentation", None)
    return record


def _box(annotation: dict[str, Any], path: Path, field: str) -> Box:
    """The box of an annotation, or the box around its polygons."""
    if annotation.get("bbox"):
        return box_of(annotation["bbox"], path, f"{field}.bbox")
    polygons = annotation.get("segmentation")
    if isinstance(polygons, dict):
        raise UserError(path, f"{field}.bbox", "none, only a run-length mask (RLE)", "a bbox or polygons")
    if not polygons:
        raise UserError(path, f"{field}.bbox", annotation.get("bbox"), "a bbox or polygons (segmentation)")
    points = []
    for polygon in polygons if isinstance(polygons, list) else []:
        if not isinstance(polygon, list) or len(polygon) % 2 or not polygon:
            raise UserError(path, f"{field}.segmentation", polygon, "lists of alternating x and y")
        points += list(zip(polygon[::2], polygon[1::2], strict=True))
    return around(points, path, f"{field}.segmentation")


def _flag(value: Any) -> bool:
    return value not in (None, 0, False, "0", "")


def _records(content: dict[str, Any], name: str, path: Path) -> list[dict[str, Any]]:
    """A list of JSON objects; a missing list of categories counts as empty."""
    records = content.get(name, [] if name == "categories" else None)
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise UserError(path, name, type(records).__name__, "a list of objects, as in COCO")
    return records


def _id_of(record: dict[str, Any], name: str, field: str, path: Path) -> str:
    identity = _id_text(record.get(name))
    if identity is None:
        raise UserError(path, f"{field}.{name}", record.get(name), "a number or a name")
    return identity


def _id_text(value: Any) -> str | None:
    """An id as text: some tools write 1, others "1" or 1.0."""
    if isinstance(value, float) and value % 1 == 0:
        value = int(value)
    return str(value) if isinstance(value, int | str) and not isinstance(value, bool) else None
