"""Pascal VOC (an XML file per image) and CVAT for images (one XML file).

Corners are used as written, and count from the outer corner of the top-left pixel, as in the files of labelImg and
Roboflow. The development kit of Pascal VOC numbers pixels from 1, so its boxes lack one pixel at the left and at the
top.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import Box, around, around_ellipse, around_turned, box_of, size_of
from perilune_train.detect.images.labels.image_set import Entry, LabelFile, LabelledObject
from perilune_train.detect.images.labels.texts import find_picture, read_xml

_CORNERS = ("xmin", "ymin", "xmax", "ymax")


def read_voc(path: Path, picture: Path, name: str) -> Entry:
    """Read the objects of one Pascal VOC file; objects marked `difficult` are ignored."""
    root = read_xml(path, "a Pascal VOC file")
    if root.tag != "annotation":
        raise UserError(path, "XML", f"<{root.tag}>", "<annotation>, as in Pascal VOC")
    objects = []
    for k, element in enumerate(root.findall("object")):
        field = f"object {k + 1}"
        box = element.find("bndbox")
        if box is None:
            raise UserError(path, field, "no <bndbox>", "xmin, ymin, xmax and ymax")
        x0, y0, x1, y1 = (_number(box.findtext(corner), path, f"{field}: {corner}") for corner in _CORNERS)
        shape = box_of((x0, y0, x1 - x0, y1 - y0), path, field)
        difficult = (element.findtext("difficult") or "0").strip() not in ("", "0", "false", "False")
        objects.append(LabelledObject(shape, " ".join((element.findtext("name") or "").split()), difficult))
    size = size_of(root.findtext("size/width"), root.findtext("size/height"), path, "size")
    return Entry(name, picture, objects, path, size)


def read_cvat(path: Path, image_folder: Path | None = None) -> LabelFile:
    """Read a file of CVAT for images: boxes, polygons, ellipses and masks.

    Other shapes are omitted; a note states their number.
    """
    root = read_xml(path, "a file of CVAT for images")
    if root.tag != "annotations" or root.find("track") is not None:
        got = "tracks of CVAT for video" if root.find("track") is not None else f"<{root.tag}>"
        raise UserError(path, "XML", got, "<annotations> with <image>, as in CVAT for images")
    entries, n_left_out = [], 0
    for k, image in enumerate(root.findall("image")):
        field = f"image {k + 1}"
        objects = []
        for shape in image:
            box = _cvat_box(shape, path, f"{field}: {shape.tag}")
            if box is not None:
                objects.append(LabelledObject(box, " ".join(shape.get("label", "").split())))
            elif shape.get("label") is not None and shape.tag != "tag":
                n_left_out += 1
        picture = find_picture(path, image.get("name"), f"{field}: name", image_folder)
        size = size_of(image.get("width"), image.get("height"), path, f"{field}: width and height")
        entries.append(Entry(str(image.get("name")), picture, objects, path, size))
    if not entries:
        raise UserError(path, "images", "none", "<image> elements, as in CVAT for images")
    declared = {name: name for label in root.iter("label") if (name := (label.findtext("name") or "").strip())}
    used = {item.category: item.category for entry in entries for item in entry.objects}
    notes = (f"{n_left_out} points, lines and other shapes without an area are left out",) if n_left_out else ()
    return LabelFile(path, entries, declared | used, notes=notes)


def _cvat_box(shape: ET.Element, path: Path, field: str) -> Box | None:
    """The box around a shape; None for shapes without an area."""

    def numbers(*names: str) -> list[float]:
        return [_number(shape.get(name), path, f"{field}: {name}") for name in names]

    turn = _number(shape.get("rotation", "0"), path, f"{field}: rotation")
    if shape.tag == "box":
        x0, y0, x1, y1 = numbers("xtl", "ytl", "xbr", "ybr")
        return around_turned(box_of((x0, y0, x1 - x0, y1 - y0), path, field), turn)
    if shape.tag == "ellipse":
        x, y, a, b = numbers("cx", "cy", "rx", "ry")
        return around_ellipse((x, y), (a, b), turn)
    if shape.tag == "mask":
        return box_of(numbers("left", "top", "width", "height"), path, field)
    if shape.tag == "polygon":
        return around((pair.split(",") for pair in shape.get("points", "").split(";")), path, f"{field}: points")
    return None


def _number(text: str | None, path: Path, field: str) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise UserError(path, field, text, "a number") from None
