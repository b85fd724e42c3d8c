"""Pictures and label files that hide gigabytes or refer to other files: refused, or read in bounded memory."""

import json
import os
import struct
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
from PIL import Image
from rasterio.windows import Window

import perilune_train.detect.images.evaluate
import perilune_train.detect.images.predict  # noqa: F401
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.benchmark.submission import read_submission
from perilune_train.detect.images.labelled import read_images
from perilune_train.detect.images.read import MAX_PIXELS, read_grey
from tests.hostile.measured import accepted, refused

SIDE = int(MAX_PIXELS**0.5)
READ_MB = 2000
"""Memory that README and SECURITY promise for a picture of any depth."""


def ended(work, path):
    """Run a reader as a command does: one line on standard error, exit code 2."""
    try:
        work(Path(path))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def reads(path):
    ended(lambda each: print(read_grey(each).shape), path)


def reads_labels(path):
    ended(lambda each: print(len(read_images(each).images)), path)


def tiff(path, side, count, dtype, **options):
    """A TIFF without pixels: GDAL writes no block of a sparse file."""
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=count, dtype=dtype, SPARSE_OK=True, **options
    ):
        return path


TILED = {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "deflate"}


@pytest.mark.parametrize(
    ("dtype", "count", "options"),
    [("float64", 1, {}), ("uint16", 3, {"photometric": "RGB"})],
)
def test_a_small_file_of_many_deep_pixels_is_read_in_strips(tmp_path, dtype, count, options):
    path = tiff(tmp_path / "deep.tif", SIDE, count, dtype, **TILED, **options)
    assert path.stat().st_size < 200_000
    accepted(f"{count} x {dtype}", partial(reads, path), memory_mb=READ_MB, limit_s=200)


def test_larger_pictures_and_blocks_are_refused(tmp_path):
    large = tiff(tmp_path / "large.tif", SIDE + 200, 1, "uint8", **TILED)
    refused("2^29 pixels and more", main, "detect", "predict", large, naming="large.tif: size", folder=tmp_path)
    block = tiff(tmp_path / "block.tif", 20_000, 1, "float64", blockysize=20_000, compress="zstd")
    refused("a block of 3 GB", main, "detect", "predict", block, naming="block.tif: image: got blocks", folder=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["block.tif", "large.tif"]


def png(path, width, height, kind, more=b"", rows=10):
    """A PNG of some rows of zeros, whose header states any size."""

    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    depth, colour = kind
    row = 1 + width * (depth // 8) * {0: 1, 2: 3}[colour]
    packer = zlib.compressobj(1)
    pixels = b"".join(packer.compress(bytes(row)) for _ in range(rows)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", pixels) + chunk(b"IEND", b""))
    return path


def test_pictures_that_pillow_decodes_as_a_whole(tmp_path):
    """The limit counts bytes, not only pixels."""
    for name, kind in {"8-bit colours": (8, 2), "16-bit colours": (16, 2), "16 bits": (16, 0)}.items():
        path = png(tmp_path / "a.png", 60_000, 10_000, kind)
        refused(name, main, "detect", "predict", path, naming="a.png: size", folder=tmp_path)
    path = png(tmp_path / "b.png", 15_000, 10_000, (8, 2), rows=10_000)
    accepted("150 million colours", partial(reads, path), memory_mb=READ_MB)


def test_text_of_100_mb_is_not_read_as_orientation(tmp_path):
    text = b"zTXt" + b"Raw profile type exif\0\0" + zlib.compress(b"\nexif\n 9\n" + b"00" * 50_000_000)
    more = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    path = png(tmp_path / "t.png", 64, 64, (8, 0), more, rows=64)
    accepted("100 MB of EXIF", partial(reads, path), memory_mb=300)


def tags(path, entries, big=False):
    """A TIFF of tags (number, type, count, value or offset)."""
    head = (
        b"II\x2b\0\x08\0\0\0" + struct.pack("<QQ", 16, len(entries))
        if big
        else b"II*\0" + struct.pack("<IH", 8, len(entries))
    )
    rows = b"".join(struct.pack("<HHQQ" if big else "<HHII", *entry) for entry in entries)
    path.write_bytes(head + rows + bytes(16))
    return path


def test_tags_that_state_gigabytes(tmp_path):
    size = [(256, 3, 1, 64), (257, 3, 1, 64), (258, 3, 1, 8)]
    for name, big, more in (
        ("a tag of 4 GB", False, [(274, 4, 2**30, 100)]),
        ("strips of 16 EB", True, [(273, 16, 2**61, 100)]),
        ("orientation as text", False, [(274, 2, 4, 0x41414141)]),
    ):
        path = tags(tmp_path / "t.tif", [*size, *more], big)
        refused(name, partial(reads, path), naming="t.tif: image")


HOSTILE_TEXTS = {
    "vrt": '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
    "<SourceFilename>SECRET</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
    "wms": "<GDAL_WMS><Service name='TMS'><ServerUrl>http://127.0.0.1:9/x</ServerUrl></Service></GDAL_WMS>",
    "wcs": "<WCS_GDAL><ServiceURL>http://127.0.0.1:9/x</ServiceURL></WCS_GDAL>",
    "pds": 'PDS_VERSION_ID = PDS3\r\n^IMAGE = "SECRET"\r\nOBJECT = IMAGE\r\n LINES = 9\r\n LINE_SAMPLES = 9\r\n'
    " SAMPLE_BITS = 8\r\n SAMPLE_TYPE = MSB_UNSIGNED_INTEGER\r\nEND_OBJECT = IMAGE\r\nEND\r\n",
    "cube": "Object = IsisCube\n Object = Core\n ^Core = SECRET\n Format = BandSequential\n Group = Dimensions\n"
    "  Samples = 9\n  Lines = 9\n  Bands = 1\n End_Group\n Group = Pixels\n  Type = UnsignedByte\n"
    "  ByteOrder = Lsb\n  Base = 0.0\n  Multiplier = 1.0\n End_Group\n End_Object\nEnd_Object\nEnd\n",
    "address": 'PDS_VERSION_ID = PDS3\r\n^IMAGE = "/vsicurl/http://127.0.0.1:9/x"\r\nEND\r\n',
}


@pytest.mark.parametrize("suffix", ["tif", "png", "IMG", "cub", "jp2"])
def test_texts_that_refer_to_other_files_are_no_pictures(tmp_path, suffix):
    secret = tmp_path / "outside" / "secret.txt"
    secret.parent.mkdir()
    secret.write_bytes(bytes(range(81)))
    given = tmp_path / "given"
    given.mkdir()
    for name, text in HOSTILE_TEXTS.items():
        path = given / f"p.{suffix}"
        path.write_text(text.replace("SECRET", "../outside/secret.txt"))
        refused(f"{name} named .{suffix}", main, "detect", "predict", path, naming=path.name, folder=tmp_path)
    link = given / "data.img"
    link.symlink_to(secret)
    path.write_text(HOSTILE_TEXTS["pds"].replace("SECRET", "data.img"))
    refused("a link out of the folder", main, "detect", "predict", path, naming="data.img", folder=tmp_path)


def test_pipes_and_devices_are_no_pictures(tmp_path):
    os.mkfifo(tmp_path / "p.png")
    for path in (tmp_path / "p.png", Path("/dev/zero")):
        refused(path.name, main, "detect", "predict", path, naming="a pipe or a device", folder=tmp_path, limit_s=20)


def picture(folder):
    folder.mkdir(exist_ok=True)
    Image.fromarray(np.zeros((30, 40), np.uint8)).save(folder / "a.png")
    return folder


LISTS = "[" + "[]," * 9_000_000 + "[]]"
HOSTILE_LABELS = {
    "annotations.json": {
        "9 million lists": LISTS,
        "9 million objects": LISTS.replace("[]", "{}"),
        "deep lists": "[" * 2_000_000,
        "a number of 1 MB": '{"images": [{"id": 1' + "0" * 1_000_000 + "}]}",
        "an id of 50 MB": json.dumps({"images": [{"id": "x" * 50_000_000, "file_name": 3}], "annotations": []}),
    },
    "a.json": {"9 million lists": LISTS, "no object": "3"},
    "a.xml": {
        "5 million elements": "<annotation>" + "<a/>" * 5_000_000 + "</annotation>",
        "entities": "<!DOCTYPE a [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;'>]><annotation>&b;</annotation>",
        "deep elements": "<a>" * 1_000_000,
    },
    "annotations.xml": {"5 million elements": "<annotations>" + "<image/>" * 5_000_000 + "</annotations>"},
    "a.txt": {
        "70 MB": "0 0.5 0.5 0.1 0.1\n" * 4_000_000,
        "a long row": "0 " + "0.5 " * 5_000_001,
    },
    "data.yaml": {
        "aliases": "a: &a [x, x, x]\nb: &b [*a, *a, *a]\nnames: [*b, *b]\ntest: x\n",
        "1 MB": "names: [" + "x, " * 400_000 + "]\n",
    },
}


@pytest.mark.parametrize("name", HOSTILE_LABELS)
def test_label_files_that_fill_the_memory_are_refused(tmp_path, name):
    for case, text in HOSTILE_LABELS[name].items():
        root = picture(tmp_path / "set")
        path = root / name
        path.write_text(text)
        refused(f"{name}: {case}", partial(reads_labels, root), naming=name, memory_mb=600)


def test_a_large_export_is_read(tmp_path):
    """60 MB of annotations as perilune writes them: polygons are dropped while the file is read."""
    root = picture(tmp_path / "set")
    one = {"image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4], "segmentation": [[0.123] * 64], "ellipse": [1.5] * 5}
    content = {"images": [{"id": 1, "file_name": "a.png"}], "annotations": [one] * 100_000, "categories": []}
    (root / "annotations.json").write_text(json.dumps(content))
    accepted("100,000 annotations", partial(reads_labels, root), memory_mb=900)


@pytest.mark.parametrize("n_rows", [5_000_000, 30_000_000])
def test_a_submission_that_states_many_rows_is_refused(tmp_path, n_rows):
    frame = pa.DictionaryArray.from_arrays(pa.array(np.zeros(n_rows, np.int8)), pa.array(["f" * 200]))
    columns = {"dataset": frame, "frame_id": frame}
    columns |= {name: pa.array(np.zeros(n_rows)) for name in ("x0_px", "y0_px", "x1_px", "y1_px", "score")}
    path = tmp_path / "mine.parquet"
    pq.write_table(pa.table(columns), path, compression="zstd")
    assert path.stat().st_size < 3_000_000
    read = partial(ended, lambda each: read_submission(each, {"f": ["f"]}), path)
    refused(f"{n_rows} rows", read, naming="rows")


def test_a_strip_of_the_narrow_angle_camera(tmp_path):
    """5064 x 52224 pixels of 16 bits, at a scale that needs few tiles; reading does not depend on it."""
    width, height, rows = 5064, 52224, 2048
    part = np.random.default_rng(0).integers(100, 2000, (rows, width)).astype(np.uint16)
    path = tmp_path / "strip.tif"
    with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint16") as image:
        for top in range(0, height, rows):
            image.write(part[None, : min(rows, height - top)], window=Window(0, top, width, min(rows, height - top)))
    del part
    arguments = ("detect", "predict", path, "--scale", "0.1", "--out", tmp_path / "out")
    accepted("a NAC strip", main, *arguments, memory_mb=2000, limit_s=200)
