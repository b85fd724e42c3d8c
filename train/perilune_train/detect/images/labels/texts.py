"""Read label files as text, JSON or XML; limit the file size and the memory that parsing takes."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.errors import UserError

_MAX_TEXT, _MAX_XML, _MAX_JSON = 2**26, 2**26, 2**29
_MAX_BRACKETS = 2**22
"""Limit on objects, lists and elements: each takes 50 to 250 bytes of memory, but as few as 3 bytes in a file."""
_DOCUMENT_TYPES = ("<!DOCTYPE", "<!ENTITY")


def read_text(path: Path, field: str, largest: int = _MAX_TEXT) -> str:
    """Read a text file in UTF-8. Raises UserError if it is missing, too large or in another encoding."""
    if not path.is_file():
        raise UserError(path, field, "no such file", "a label file")
    size = path.stat().st_size
    if size > largest:
        raise UserError(path, field, f"{size} bytes", f"at most {largest} bytes")
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(path, field, "bytes that are not UTF-8 text", "a label file in UTF-8") from None


def read_json(path: Path, expected: str, hook: Callable[[dict], Any] | None = None) -> Any:
    """Read a JSON file; `hook` replaces each object while parsing, for example to drop parts of it."""
    text = read_text(path, "JSON", _MAX_JSON)
    if text.count("[") + text.count("{") > _MAX_BRACKETS:
        raise UserError(path, "JSON", f"more than {_MAX_BRACKETS} lists and objects", "fewer, in several files")
    try:
        return json.loads(text, object_hook=hook)
    except (ValueError, RecursionError) as error:
        raise UserError(path, "JSON", error, expected) from None


def read_xml(path: Path, expected: str) -> ET.Element:
    """Read an XML file; returns the root element.

    Document types are refused, because entities can fill the memory or refer to other files.
    """
    text = read_text(path, "XML", _MAX_XML)
    if any(word in text for word in _DOCUMENT_TYPES):
        raise UserError(path, "XML", "a document type or an entity", expected)
    if text.count("<") > _MAX_BRACKETS:
        raise UserError(path, "XML", f"more than {_MAX_BRACKETS} elements", "fewer, in several files")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError, RecursionError) as error:
        raise UserError(path, "XML", error, expected) from None


def below(folder: Path, name: Any, path: Path, field: str) -> Path:
    """The path `name` below a folder. Raises UserError if it leads outside the folder, also by a link."""
    if isinstance(name, str) and name and "\0" not in name:
        # Labels made on Windows have backslashes.
        parts = name if "\\" not in name or folder.joinpath(name).exists() else name.replace("\\", "/")
        try:
            resolved = folder.joinpath(parts).resolve()
        except (OSError, RuntimeError):  # circular links
            resolved = folder
        if resolved != folder and resolved.is_relative_to(folder):
            return resolved
    raise UserError(path, field, name, "a path of an image below the labels' folder, or below images next to it")


def find_picture(path: Path, name: Any, field: str, image_folder: Path | None) -> Path:
    """Path of the picture that a label file names, in the first searched folder that contains it.

    If `image_folder` is given, searches only this folder. Otherwise searches the folder of the label file, its
    subfolder images, ../images, ../images/NAME and ../NAME, where NAME is the last part of the file's name (train2017
    for instances_train2017.json). If the label file is in a direct subfolder of a perilune dataset, searches the
    dataset's folder too.
    """
    root = path.resolve().parent
    ending = path.stem.rpartition("_")[2]
    images = root.parent / "images"
    folders = [root, root / "images", images, images / ending, root.parent / ending]
    if (root.parent / INFO_NAME).is_file():
        folders.append(root.parent)
    for folder in folders if image_folder is None else [image_folder.resolve()]:
        picture = below(folder, name, path, field)
        if picture.is_file():
            return picture
    if image_folder is not None:
        raise UserError(below(image_folder.resolve(), name, path, field), "image", "no such file", "the picture")
    missing = below(root, name, path, field)
    raise UserError(missing, "image", "no such file", "the picture; --image-folder names the folder of the pictures")
