"""List the pictures of a folder, without hidden files, masks and overlays."""

from pathlib import Path

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_train.detect.images.read import SUFFIXES

_PICTURES = tuple(suffix for suffix in SUFFIXES if suffix != ".lbl")
_MASK_ENDINGS = ("mask", "masks", "seg", "label", "labels", "instances", "overlay")
_FOLDERS_OF_ARCHIVES = ("__MACOSX",)


def is_picture(path: Path) -> bool:
    """Whether a file has the suffix of a picture."""
    return path.suffix.lower() in _PICTURES


def pictures_of(folder: Path, recursive: bool = False) -> list[Path]:
    """The pictures of a folder, sorted; a message states how many files were omitted.

    Omits hidden files (`._x.png` of macOS), and masks and overlays of other pictures (`x_mask.png` beside `x.png`).
    If the label of a PDS3 image is a separate file (.lbl), lists this file instead of the data file (.img). Raises
    UserError if a name is not UTF-8.
    """
    paths = sorted(path for path in (folder.rglob("*") if recursive else folder.iterdir()) if path.is_file())
    visible = [path for path in paths if not _is_hidden(path, folder)]
    labels = {path.with_suffix("").as_posix().lower(): path for path in visible if path.suffix.lower() == ".lbl"}
    pictures = [path for path in visible if is_picture(path)]
    for path in pictures:
        if not path.name.isascii() and any("\ud800" <= sign <= "\udfff" for sign in path.name):
            raise UserError(folder, "image", path.name, "file names in UTF-8")
    stems = {path.with_suffix("").as_posix() for path in pictures} | {path.as_posix() for path in pictures}
    masks = {path for path in pictures if _is_mask(path, stems)}
    n_hidden = sum(is_picture(path) for path in paths) - len(pictures)
    if masks or n_hidden:
        parts = [f"{n_hidden} hidden files"] * bool(n_hidden) + [f"{len(masks)} masks or overlays"] * bool(masks)
        say(f"{folder.name}: {' and '.join(parts)} are left out")
    images = []
    for path in pictures:
        if path not in masks:
            label = labels.get(path.with_suffix("").as_posix().lower()) if path.suffix.lower() == ".img" else None
            images.append(label or path)
    return images


def check_names(paths: list[Path], names: list[str]) -> None:
    """Raise UserError if two pictures have equal names; tables and overlays identify pictures by name."""
    seen: set[str] = set()
    for path, name in zip(paths, names, strict=True):
        if name in seen:
            raise UserError(path, "name", "a second image of this name", "unique file names")
        seen.add(name)


def _is_hidden(path: Path, folder: Path) -> bool:
    parts = path.relative_to(folder).parts
    return any(part.startswith(".") or part in _FOLDERS_OF_ARCHIVES for part in parts)


def _is_mask(path: Path, stems: set[str]) -> bool:
    """Whether a file is named after another picture, with an ending such as `_mask`."""
    stem = path.with_suffix("").as_posix()
    return any(
        stem.lower().endswith(f"{sign}{ending}") and stem[: -len(ending) - 1] in stems
        for ending in _MASK_ENDINGS
        for sign in "_-."
    )
