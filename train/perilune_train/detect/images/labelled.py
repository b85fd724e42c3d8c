"""Read labelled images in the common layouts of other tools.

| Source | Layout |
|---|---|
| COCO | a JSON file, or a folder with one JSON file or with one per split |
| YOLO | a data.yaml or its folder, a list of images (.txt), or folders images/ and labels/ |
| CVAT for images | an XML file, or a folder that holds annotations.xml |
| Pascal VOC, LabelMe, YOLO, tables of boxes | a file beside each image, or in labels/, Annotations/ or annotations/ |

If a folder has splits (train, val or valid, test), one split is read (`Request.split`). The origin of coordinates is
the outer corner of the top-left pixel of the upright image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_train.detect.images.labels import yolo
from perilune_train.detect.images.labels.coco import is_coco, read_coco, read_content
from perilune_train.detect.images.labels.image_set import (
    Entry,
    ImageSet,
    LabelFile,
    LabelledImage,
    LabelledObject,
    image_set,
)
from perilune_train.detect.images.labels.labelme import read_labelme
from perilune_train.detect.images.labels.tables import read_table
from perilune_train.detect.images.labels.texts import read_text
from perilune_train.detect.images.labels.xml_files import read_cvat, read_voc
from perilune_train.detect.images.pictures import pictures_of

__all__ = ["ImageSet", "LabelledImage", "Request", "read_images", "read_table"]
_COCO_NAMES = ("annotations.json", "_annotations.coco.json")
_YAML = (".yaml", ".yml")
_PICTURE_FOLDERS = ("images", "Images", "JPEGImages", "imgs")
_LABEL_FOLDERS = ("labels", "Annotations", "annotations", "xmls")
_LABEL_SUFFIXES = (".txt", ".xml", ".json")
_DEFAULT_SPLIT = "test"


@dataclass(frozen=True)
class Request:
    """What to read from a source."""

    split: str | None = None
    """train, val or test; None for test, or for the only split of the source."""
    categories: tuple[str, ...] = ()
    """Names of the categories that count as craters; () for "crater" and "craters"."""
    image_folder: Path | None = None
    """Folder of the images that a COCO or CVAT file names; None to search the folders near the file."""


def read_images(source: Path, request: Request = Request()) -> ImageSet:
    """Read the labelled images of a folder or a label file.

    Raises UserError, which names file and line, if the source has no labelled images or a file is not valid.
    """
    if source.is_dir():
        label_file, split = _from_folder(source, request)
    elif source.is_file():
        label_file, split = _from_file(source, request)
    else:
        raise UserError(source, "--images", "no such folder", "a folder of images with labels, or a label file")
    if request.split is not None and not split:
        raise UserError("--split", "", request.split, f"a source with splits; {source.name} has none")
    if split:
        say(f"{source.name}: {split}")
    return replace(image_set(label_file, request.categories), split=split)


def _from_file(path: Path, request: Request) -> tuple[LabelFile, str]:
    suffix = path.suffix.lower()
    if suffix in _YAML:
        return _from_yaml(path, request)
    if suffix == ".xml":
        return read_cvat(path, request.image_folder), ""
    if suffix == ".txt":
        return _from_yolo(path, yolo.listed_pictures(path), {}), ""
    return read_coco(path, read_content(path), request.image_folder), ""


def _from_folder(folder: Path, request: Request) -> tuple[LabelFile, str]:
    for name in _COCO_NAMES:
        if (folder / name).is_file():
            return _from_file(folder / name, request)
    yamls = sorted(path for path in folder.iterdir() if path.suffix.lower() in _YAML and "names" in _head(path))
    if yamls:
        return _from_yaml(yamls[0], request)
    if (folder / "annotations.xml").is_file():
        return _from_file(folder / "annotations.xml", request)
    jsons = _coco_files(folder)
    if jsons:
        key, text = _split({_split_of(path.stem.rpartition("_")[2]): path for path in jsons}, jsons, request, folder)
        return _from_file(key, request)[0], text
    splits = {_split_of(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}
    splits.pop("", None)
    if splits:
        part, text = _split(splits, list(splits.values()), request, folder)
        return _from_folder(part, replace(request, split=None))[0], text
    return _from_image_folder(folder, request)


def _split(by_split: dict[str, Path], paths: list[Path], request: Request, source: Path) -> tuple[Path, str]:
    """Choose one of several splits; returns its path and a text that names the split.

    The text is "" if there is only one path and it was not chosen by a requested split.
    """
    named = {split: path for split, path in by_split.items() if split}
    if len(paths) == 1 and not (named and request.split):
        return paths[0], ""
    wanted = request.split or (_DEFAULT_SPLIT if _DEFAULT_SPLIT in named else None)
    if wanted is None or wanted not in named:
        names = ", ".join(named) or ", ".join(path.name for path in paths)
        raise UserError(source, "splits", names, f"{wanted or 'test'} among them, or --split, or the path of one split")
    return named[wanted], f"split {wanted} of {', '.join(named)}"


def _split_of(name: str) -> str:
    """train, val or test from the name of a folder or the ending of a file name; "" for other names."""
    return next((split for split, names in yolo.SPLIT_KEYS.items() if name.lower().rstrip("0123456789") in names), "")


def _coco_files(folder: Path) -> list[Path]:
    """The COCO files of a folder or of its subfolder annotations; skips JSON files of LabelMe."""
    for parent in (folder, folder / "annotations"):
        paths = sorted(parent.glob("*.json")) if parent.is_dir() else []
        stems = {path.stem for path in pictures_of(parent)} if paths else set()
        candidates = [path for path in paths if path.stem not in stems and not path.name.startswith(".")]
        candidates = [path for path in candidates if '"shapes"' not in (head := _head(path)) and "{" in head]
        # COCO's own downloads also contain files of captions and key points.
        candidates = [path for path in candidates if path.stem.startswith("instances")] or candidates
        if len(candidates) == 1:
            return candidates if is_coco(read_content(candidates[0])) else []
        if candidates and all(_split_of(path.stem.rpartition("_")[2]) for path in candidates):
            return candidates
    return []


def _head(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(2**16).decode("utf-8", "replace")


def _from_yaml(path: Path, request: Request) -> tuple[LabelFile, str]:
    content = yolo.read_data_yaml(path)
    values = {split: content[key] for split, keys in yolo.SPLIT_KEYS.items() for key in keys if content.get(key)}
    if not values:
        raise UserError(path, "splits", "none", "train, val or test, each with a folder or a list of images")
    wanted = request.split or (_DEFAULT_SPLIT if _DEFAULT_SPLIT in values or len(values) > 1 else next(iter(values)))
    if wanted not in values:
        raise UserError(path, "splits", ", ".join(values), f"{wanted} among them, or --split")
    text = f"split {wanted} of {', '.join(values)}"
    return _from_yolo(path, yolo.pictures_of_split(path, values[wanted]), yolo.class_names(content)), text


def _from_yolo(source: Path, pictures: list[Path], names: dict[str, str]) -> LabelFile:
    """Read pictures and their YOLO label files; a picture without a label file has no objects."""
    root = source.resolve().parent if source.is_file() else source.resolve()
    entries, n_absent = [], 0
    for picture in pictures:
        text = yolo.label_of(picture)
        present = text.is_file()
        n_absent += not present
        objects = yolo.read_yolo_text(text, picture) if present else []
        name = (
            picture.resolve().relative_to(root).as_posix() if picture.resolve().is_relative_to(root) else picture.name
        )
        entries.append(Entry(name, picture, objects, text))
    if not entries or n_absent == len(entries):
        raise UserError(source, "labels", "no image with a label file", "labels/a.txt for images/a.png")
    notes = (f"{n_absent} images without a label file count as images without craters",) if n_absent else ()
    return LabelFile(source, entries, names or _numbers_as_names(entries), notes=notes)


def _numbers_as_names(entries: Sequence[Entry]) -> dict[str, str]:
    return {item.category: item.category for entry in entries for item in entry.objects}


def _from_image_folder(folder: Path, request: Request) -> tuple[LabelFile, str]:
    """Read images that have a label file each, beside the image or in another folder."""
    images = pictures_of(folder)
    root = folder
    if not images:
        picture_folders = [folder / name for name in _PICTURE_FOLDERS if (folder / name).is_dir()]
        root = picture_folders[0] if picture_folders else folder
        images = pictures_of(root, recursive=True) if picture_folders else []
    if not images:
        raise UserError(folder, "--images", "no PNG, TIFF or JPEG", "images with labels beside them")
    labels = [root, *(folder / name for name in _LABEL_FOLDERS if (folder / name).is_dir())]
    by_suffix = {suffix: {} for suffix in _LABEL_SUFFIXES}  # type: dict[str, dict[Path, Path]]
    for picture in images:
        for label_folder in labels:
            for suffix in _LABEL_SUFFIXES:
                path = (label_folder / picture.relative_to(root)).with_suffix(suffix)
                if path.is_file() and path not in images:
                    by_suffix[suffix].setdefault(picture, path)
    kinds = [suffix for suffix, files in by_suffix.items() if files]
    if not kinds:
        missing = images[0].with_suffix(".txt")
        raise UserError(missing, "boxes", "no such file", "a label file for each image (.txt, .xml or .json)")
    if len(kinds) > 1:
        raise UserError(folder, "labels", f"files of {len(kinds)} kinds: {', '.join(kinds)}", "one kind")
    files = by_suffix[kinds[0]]
    return _from_pairs(folder, root, files, len(images) - len(files)), ""


def _from_pairs(folder: Path, root: Path, files: dict[Path, Path], n_unlabelled: int) -> LabelFile:
    """Read the label file of each picture."""
    pictures_by_label: dict[Path, Path] = {}
    for picture, path in files.items():
        if path in pictures_by_label:
            got = f"{path.name}, also the label file of {pictures_by_label[path].name}"
            raise UserError(picture, "labels", got, "one image for each label file")
        pictures_by_label[path] = picture
    suffix = next(iter(pictures_by_label)).suffix.lower()
    notes = [f"{n_unlabelled} images without labels are left out"] if n_unlabelled else []
    entries, clip, n_without_area = [], True, 0
    names: dict[str, str] = {}
    read = _text_reader(list(pictures_by_label)) if suffix == ".txt" else None
    for path, picture in pictures_by_label.items():
        name = picture.relative_to(root).as_posix()
        if suffix == ".xml":
            entries.append(read_voc(path, picture, name))
        elif suffix == ".json":
            entry, without_area = read_labelme(path, picture, name)
            entries.append(entry)
            n_without_area += without_area
        elif read is not None:
            entries.append(Entry(name, picture, read[0](path, picture), path))
            clip = read[1]
    if n_without_area:
        notes.append(f"{n_without_area} points and lines are left out")
    if suffix == ".txt" and clip:
        names = _names_beside(folder)
    return LabelFile(folder, entries, names or _numbers_as_names(entries), clip, tuple(notes))


def _text_reader(paths: list[Path]) -> tuple[Callable[[Path, Path], list[LabelledObject]], bool]:
    """Reader for YOLO files or tables, chosen by the first non-empty file, and whether to clip its boxes."""
    first = next((text for path in paths if (text := read_text(path, "boxes")).strip()), "")
    if yolo.is_yolo(first):
        return yolo.read_yolo_text, True
    return _table_objects, False


def _table_objects(path: Path, picture: Path) -> list[LabelledObject]:
    del picture
    return [LabelledObject(tuple(box)) for box in read_table(path).tolist()]


def _names_beside(folder: Path) -> dict[str, str]:
    """Names of YOLO's classes from classes.txt, as labelImg writes it; {} if there is none."""
    for path in (folder / "classes.txt", folder / "labels" / "classes.txt"):
        if path.is_file():
            lines = [line.strip() for line in read_text(path, "names").splitlines()]
            return {str(number): name for number, name in enumerate(lines) if name}
    return {}
