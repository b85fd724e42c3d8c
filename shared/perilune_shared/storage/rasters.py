"""Open untrusted rasters with rasterio, in a few documented formats and without reading other files.

GDAL, which rasterio calls, opens more than a user expects. It recognises about a hundred formats whatever the suffix,
among them text that refers to other files or to addresses. It also reads files that are beside a raster or named in the
raster's tags. Therefore this module recognises the format itself, permits only the driver of this format, and opens the
raster in a temporary folder that contains links to the raster's files and no other files. rasterio is optional in some
packages, so it is imported where it is used.
"""

import contextlib
import html
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from perilune_shared.errors import UserError
from perilune_shared.storage.files import inside

MODEL_DRIVERS = ("GTiff", "JP2OpenJPEG", "PDS", "PDS4", "ISIS3")
"""GDAL's drivers for elevation models. A Cloud Optimized GeoTIFF is a GeoTIFF."""
PICTURE_DRIVERS = (*MODEL_DRIVERS, "PNG", "JPEG")
"""GDAL's drivers for pictures."""
_NAMES = {
    "GTiff": "GeoTIFF",
    "JP2OpenJPEG": "JPEG 2000",
    "PDS": "PDS3",
    "PDS4": "PDS4",
    "ISIS3": "ISIS cube",
    "PNG": "PNG",
    "JPEG": "JPEG",
    "VRT": "VRT",
}
_MAGIC = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"\0\0\0\x0cjP  \r\n\x87\n": "JP2OpenJPEG",
    b"\xff\x4f\xff\x51": "JP2OpenJPEG",
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"\xff\xd8\xff": "JPEG",
}
_VRT_ELEMENTS = re.compile(
    "VRTDataset|SRS|GeoTransform|Metadata|MDI|VRTRasterBand|Description|UnitType|Offset|Scale|NoDataValue|"
    "HideNoDataValue|ColorInterp|SimpleSource|ComplexSource|SourceFilename|SourceBand|SourceProperties|SrcRect|DstRect|"
    "NODATA|ScaleOffset|ScaleRatio|UseMaskBand"
)
"""Permitted elements of a VRT; other elements compute values or refer to more files."""
_OPTIONS = {"GDAL_PAM_ENABLED": "NO", "CPL_VSIL_CURL_ALLOWED_FILENAME": "none", "PROJ_NETWORK": "OFF"}
_LARGEST_LABEL_BYTES = 2**22
_LARGEST_WORLD_FILE_BYTES = 4096
_LARGEST_BLOCK_BYTES = 2**29
"""Maximum size of a decoded block (tile or strip) with all interleaved bands, bytes: GDAL decodes whole blocks."""
_VALUE_BYTES = {"uint8": 1, "int8": 1, "uint16": 2, "int16": 2, "uint32": 4, "int32": 4, "float32": 4}
_END = re.compile(rb"\r?\nE(?:ND|nd)\r?\n")
_POINTER = re.compile(r"^[ \t]*(\^\w+|FILE_NAME)[ \t]*=[ \t\r\n]*\(?[ \t]*(\"[^\"]*\"|'[^']*'|[^\s,)]+)", re.M | re.I)
_FILE_NAME = re.compile(r"<(?:\w+:)?file_name\b[^>]*>(.*?)</", re.S)


@dataclass(frozen=True, slots=True)
class RasterFiles:
    """Files of a raster, and the driver that reads them."""

    driver: str
    """GDAL's short name of the driver."""
    named: tuple[tuple[str, Path], ...]
    """Name and path of each file: first the file that GDAL opens, then data named by a label, then a world file. The
    name of a data file is written as in the label; in the path, the letter case may differ."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """Paths of all files; the first is the file that GDAL opens."""
        return tuple(path for _, path in self.named)


def raster_files(
    path: Path,
    drivers: Sequence[str] = MODEL_DRIVERS,
    field: str = "raster",
    tiles: Sequence[str] | None = None,
) -> RasterFiles:
    """Return the files of a raster in one of the formats of `drivers`.

    A VRT, GDAL's text format that joins several rasters, is permitted only with `tiles`: all files to which it may
    refer, as paths relative to its folder. GDAL opens these tiles, so that they are checked; it does not open the
    raster itself. `field` is the name of the setting in messages. Raises UserError if the file is missing or has
    another format, if a label names a file outside its folder, if a VRT refers to files not in `tiles` or does more
    than join them, or if one of the files is not a regular file.
    """
    if not path.is_file():
        found = "no such file" if not path.exists() else "a folder, a pipe or a device"
        raise UserError(path, field, found, _expected(drivers))
    with path.open("rb") as stream:
        head = stream.read(_LARGEST_LABEL_BYTES)
    driver = _driver_of(head)
    if tiles is not None:
        return _vrt_files(path, head, field, tiles)
    if driver not in drivers:
        text = "XML text, which can refer to other files" if head.lstrip().startswith(b"<") else "another format"
        found = _NAMES.get(driver, text)
        raise UserError(path, field, found, _expected(drivers) + _hint(path, head))
    files = {path.name: path}
    if driver in ("PDS", "PDS4", "ISIS3"):
        for name in _named_by_label(path, driver, head, field):
            if (beside := _beside(path, name, field)) is not None:
                files.setdefault(name, beside)
    for beside in _world_file(path):
        files.setdefault(beside.name, beside)
    return RasterFiles(driver, tuple(files.items()))


@contextlib.contextmanager
def opened_raster(files: RasterFiles, field: str = "raster") -> Iterator[Any]:
    """Open a raster and yield it as a `rasterio.DatasetReader`. Needs rasterio.

    Other files beside the raster (.aux.xml, .ovr, .msk) are not read. Raises UserError if the raster cannot be opened
    or read, also within the `with` block; if tags or projection refer to other files; or if a block is too large.
    """
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import CRSError, RasterioError

    path = files.paths[0]
    with tempfile.TemporaryDirectory(prefix="perilune-raster-") as folder:
        for name, file in files.named:
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            if files.driver == "VRT" and file == path:
                # GDAL would follow a link to a VRT and look for the tiles in the original folder, so copy the VRT.
                shutil.copyfile(file, Path(folder) / name)
            else:
                (Path(folder) / name).symlink_to(file.resolve())
        try:
            with rasterio.Env(**_OPTIONS):
                with warnings.catch_warnings():
                    # Callers that need a georeference report its absence themselves.
                    warnings.simplefilter("ignore")
                    raster = rasterio.open(Path(folder) / path.name, driver=files.driver, sharing=False)
                with raster:
                    _refuse_references(path, raster, Path(folder), field)
                    yield raster
        # rasterio does not wrap all errors of GDAL.
        except (RasterioError, CRSError, CPLE_BaseError) as error:
            found = str(error.__cause__ or error).replace(f"{folder}{os.sep}", "")
            raise UserError(path, field, found, f"a readable {_NAMES[files.driver]}") from None


def label_text(files: RasterFiles) -> str:
    """Return the text of a PDS label, without the data after the label."""
    with files.paths[0].open("rb") as stream:
        return _label_in(stream.read(_LARGEST_LABEL_BYTES), files.driver)


def _label_in(head: bytes, driver: str) -> str:
    if driver == "PDS4":
        return html.unescape(head.decode("utf-8", "replace"))
    end = _END.search(head)
    return head[: end.end() if end else None].decode("latin-1")


def _driver_of(head: bytes) -> str:
    """Return GDAL's driver for a file that begins with `head`, or "" if the format is not supported."""
    for magic, driver in _MAGIC.items():
        if head.startswith(magic):
            return driver
    start = head[: 2**16]
    if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return "PDS4" if b"Product_Observational" in start and b"<VRTDataset" not in start else ""
    if b"IsisCube" in start:
        return "ISIS3"
    return "PDS" if b"PDS_VERSION_ID" in start else ""


def _expected(drivers: Sequence[str]) -> str:
    names = [_NAMES[driver] for driver in drivers]
    return f"a readable {', '.join(names[:-1])} or {names[-1]} file"


def _hint(path: Path, head: bytes) -> str:
    """Return advice on an unsupported file, to append to a message; "" if there is none."""
    if b"<VRTDataset" in head[: 2**16]:
        return f"; convert it with: gdal_translate {path.name} {path.stem}.tif, or list its tiles in vrt_files"
    for suffix in (".lbl", ".LBL", ".xml"):
        label = path.with_suffix(suffix)
        if label != path and label.is_file():
            return f"; open the data through their label, {label.name}"
    return ""


def _named_by_label(path: Path, driver: str, head: bytes, field: str) -> list[str]:
    """Return the names of the files that the label of a PDS or ISIS file names. Raises UserError."""
    label = _label_in(head, driver)
    complete = len(head) < _LARGEST_LABEL_BYTES or (driver != "PDS4" and _END.search(head) is not None)
    if driver == "PDS4":
        names = [name.strip() for name in _FILE_NAME.findall(label)]
    else:
        names = [value.strip("\"' ") for _, value in _POINTER.findall(label)]
        names = [name for name in names if not name.isdigit()]
    if not complete:
        raise UserError(path, field, "a label without an end", f"a label of at most {_LARGEST_LABEL_BYTES} bytes")
    if "/vsi" in label.lower():
        raise UserError(path, field, "a label with '/vsi', which GDAL reads as an address", "names of files")
    if driver == "PDS" and re.search(r"=\s*\"?COMPRESSED_FILE", label, re.I):
        raise UserError(path, field, "compressed data behind a label", "uncompressed PDS3 data")
    if driver == "ISIS3" and re.search(r"Format\s*=\s*\"?GeoTIFF", label, re.I):
        raise UserError(path, field, "an ISIS label of a GeoTIFF", "a cube, or the GeoTIFF itself")
    for name in names:
        if re.search(r"[/\\\0]", name) or name in ("", ".", ".."):
            raise UserError(path, field, f"a label that points to {name!r}", "names of files in its own folder")
    return names


def _vrt_files(path: Path, head: bytes, field: str, tiles: Sequence[str]) -> RasterFiles:
    """Return the files of a VRT that only joins the given tiles; see `raster_files`."""
    if b"<VRTDataset" not in head[: 2**16] or len(head) >= _LARGEST_LABEL_BYTES or b"<!" in head:
        raise UserError(path, field, "no VRT, or a long one", "a VRT with the tiles of vrt_files")
    try:
        elements = list(ElementTree.fromstring(head).iter())
    except ElementTree.ParseError as error:
        raise UserError(path, field, error, "a VRT") from None
    files = {path.name: path}
    for element in elements:
        name = (element.text or "").strip()
        if not _VRT_ELEMENTS.fullmatch(element.tag) or "subClass" in element.attrib:
            found = f"a VRT with {element.tag} {element.get('subClass', '')}".rstrip()
            raise UserError(path, field, found, "a VRT that only joins rasters")
        if element.tag != "SourceFilename":
            continue
        if element.get("relativeToVRT") != "1" or name not in tiles:
            raise UserError(path, field, f"a VRT that refers to {name!r}", f"its tiles: {', '.join(tiles)}")
        if name in files:
            continue
        files[name] = inside(path.parent, name)
        with opened_raster(raster_files(files[name], ("GTiff", "JP2OpenJPEG"), field), field):
            pass  # opening it raises UserError if its tags refer to other files
    return RasterFiles("VRT", tuple(files.items()))


def _beside(path: Path, name: str, field: str) -> Path | None:
    """Return the file `name` in the folder of the label `path`; None if it is missing.

    Ignores letter case. Raises UserError if it is not a regular file in this folder.
    """
    folder = path.resolve().parent
    beside = path.parent / name
    if not beside.exists():
        # The letter case in labels often differs from the letter case of the file names.
        same = (entry for entry in path.parent.iterdir() if entry.name.lower() == name.lower())
        beside = next(same, beside)
    if not beside.exists():
        return None  # GDAL reports missing data; a label may also name documents that were not downloaded
    if not beside.is_file():
        raise UserError(beside, field, "a folder, a pipe or a device", f"a regular file, which {path.name} names")
    if not beside.resolve().is_relative_to(folder):
        raise UserError(beside, field, "a link that leaves the folder", f"a file beside {path.name}")
    return beside


def _world_file(path: Path) -> list[Path]:
    """Return a list with the world file (.tfw, .pgw, ...) beside a raster, or an empty list."""
    suffix = path.suffix.lower().removeprefix(".")
    for ending in (f"{suffix[:1]}{suffix[-1:]}w", f"{suffix}w", "wld"):
        for beside in (path.with_suffix(f".{ending}"), path.with_suffix(f".{ending.upper()}")):
            if beside.is_file() and beside.stat().st_size <= _LARGEST_WORLD_FILE_BYTES:
                return [beside]
    return []


def _refuse_references(path: Path, raster: Any, folder: Path, field: str) -> None:
    """Raise UserError if an open raster refers to other files, or if its blocks are too large."""
    if tags := raster.tags(ns="OVERVIEWS"):
        raise UserError(path, field, f"tags that name another file: {tags}", "a raster that refers to no other file")
    if any(not Path(file).is_relative_to(folder) for file in raster.files):
        raise UserError(path, field, "a reference to a file in another folder", "data in the folder of their label")
    if raster.crs is not None:
        refuse_grids(path, raster.crs)
    rows, columns = raster.block_shapes[0]
    together = raster.count if raster.tags(ns="IMAGE_STRUCTURE").get("INTERLEAVE") == "PIXEL" else 1
    if rows * columns * together * _VALUE_BYTES.get(raster.dtypes[0], 16) > _LARGEST_BLOCK_BYTES:
        size = f"blocks of {rows} x {columns} pixels and {together} bands"
        raise UserError(path, field, size, f"blocks of at most {_LARGEST_BLOCK_BYTES} bytes: a tiled raster")


def refuse_grids(where: object, crs: Any) -> None:
    """Raise UserError if a `rasterio.crs.CRS` names files, which PROJ would open."""
    if grid := re.search(r"nadgrids|geoidgrids|\+grids|PARAMETERFILE", crs.to_wkt(), re.I):
        raise UserError(where, "projection", f"{grid[0]}, which names a file", "a projection without grids")
