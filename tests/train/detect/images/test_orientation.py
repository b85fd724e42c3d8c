"""EXIF and TIFF orientation: one rule for all formats, and places on the Moon that follow it."""

import json
import struct
import zlib

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.crs import CRS
from rasterio.transform import from_origin
from tests.sampling import every

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M
from perilune_train.detect.images.georeference import read_georeference
from perilune_train.detect.images.labelled import read_images
from perilune_train.detect.images.read import picture_size, read_grey

TAG = 274
SHAPE = 24, 40
POLAR = CRS.from_proj4(f"+proj=stere +lat_0=-90 +R={MOON_RADIUS_M:.0f} +units=m +no_defs")


def scene():
    """An upright picture in blocks of 8 pixels, which JPEG keeps; none of its turns is the same."""
    blocks = np.random.default_rng(7).permutation(15).reshape(3, 5) * 17
    return np.kron(blocks, np.ones((8, 8))).astype(np.uint8)


def stored(pixels, orientation):
    """The pixels that a viewer turns into `pixels`, by the definition in the TIFF and EXIF standards."""
    return {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.T,
        6: lambda a: np.rot90(a),
        7: lambda a: a[::-1, ::-1].T,
        8: lambda a: np.rot90(a, -1),
    }[orientation](pixels)


def by_pillow(name, **options):
    def write(path, pixels, orientation):
        exif = Image.Exif()
        exif[TAG] = orientation
        Image.fromarray(np.ascontiguousarray(pixels)).save(path / name, exif=exif, **options)
        return path / name

    return write


def late_png(path, pixels, orientation):
    """A PNG whose EXIF chunk follows the pixels."""
    place = by_pillow("late.png")(path, pixels, orientation)
    raw = place.read_bytes()
    at = raw.index(b"eXIf") - 4
    length = 12 + struct.unpack(">I", raw[at : at + 4])[0]
    end = len(raw) - 12
    place.write_bytes(raw[:at] + raw[at + length : end] + raw[at : at + length] + raw[end:])
    return place


def deep_tiff(dtype, **options):
    """A TIFF that rasterio reads; GDAL does not write the tag, so that it replaces another."""

    def write(path, pixels, orientation):
        bands = np.stack([pixels.astype(dtype) * 10] * (3 if options else 1))
        height, width = pixels.shape
        place = path / "deep.tif"
        with rasterio.open(
            place, "w", driver="GTiff", width=width, height=height, count=len(bands), dtype=dtype, **options
        ) as image:
            image.write(bands)
            image.update_tags(TIFFTAG_RESOLUTIONUNIT="2")
        raw = bytearray(place.read_bytes())
        at = next(k for k in range(8, len(raw)) if raw[k : k + 8] == struct.pack("<HHI", 296, 3, 1))
        raw[at : at + 12] = struct.pack("<HHIHH", TAG, 3, 1, orientation, 0)
        place.write_bytes(raw)
        return place

    return write


def deep_png(path, pixels, orientation):
    """16-bit colours, which OpenCV reads."""
    place = path / "deep.png"
    assert cv2.imwrite(str(place), np.dstack([pixels.astype(np.uint16) * 10] * 3))
    exif = b"MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHIHH", TAG, 3, 1, orientation, 0) + b"\0\0\0\0"
    raw = place.read_bytes()
    chunk = b"eXIf" + exif
    place.write_bytes(raw[:33] + struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + raw[33:])
    return place


WRITERS = {
    "png": by_pillow("a.png"),
    "png, EXIF after the pixels": late_png,
    "png of 16-bit colours": deep_png,
    "jpeg": by_pillow("a.jpg", quality=100),
    "tiff": by_pillow("a.tif"),
    "tiff, compressed": by_pillow("a.tif", compression="tiff_lzw"),
    "tiff, deflated in strips": by_pillow("a.tif", compression="tiff_deflate"),
    "tiff of 16 bits": deep_tiff("uint16"),
    "tiff of float": deep_tiff("float32"),
    "tiff of 16-bit colours": deep_tiff("uint16", photometric="RGB"),
}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", WRITERS)
def test_pixels_are_upright_in_every_format(tmp_path, kind, orientation):
    expected = scene()
    path = WRITERS[kind](tmp_path, stored(expected, orientation), orientation)
    read = read_grey(path)
    assert picture_size(path) == SHAPE[::-1]
    assert read.shape == SHAPE and np.abs(read.astype(int) - np.rint(expected * (255 / expected.max()))).max() <= 24
    assert np.corrcoef(read.ravel(), expected.ravel())[0, 1] > 0.999


@pytest.mark.parametrize("value", [0, 9, 65535])
def test_values_that_are_no_orientation_are_passed_over(tmp_path, value):
    for name in ("a.png", "a.jpg", "a.tif"):
        path = by_pillow(name)(tmp_path, scene(), value)
        assert picture_size(path) == SHAPE[::-1] and np.corrcoef(read_grey(path).ravel(), scene().ravel())[0, 1] > 0.99


def test_damaged_exif_leaves_the_picture_as_stored(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(scene()).save(path, exif=b"Exif\0\0MM\0*\xff\xff\xff\xffnonsense")
    assert np.array_equal(read_grey(path), scene())


def coco_of(folder, name, size, box):
    content = {
        "images": [{"id": 1, "file_name": name, "width": size[0], "height": size[1]}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": box}],
        "categories": [{"id": 1, "name": "crater"}],
    }
    path = folder / "annotations.json"
    path.write_text(json.dumps(content))
    return path


def test_labels_are_those_of_the_upright_picture(tmp_path):
    by_pillow("a.jpg")(tmp_path, stored(scene(), 6), 6)
    image = read_images(coco_of(tmp_path, "a.jpg", SHAPE[::-1], [30, 2, 8, 9])).images[0]
    assert (image.width_px, image.height_px) == SHAPE[::-1] and image.boxes.tolist() == [[30, 2, 38, 11]]
    with pytest.raises(UserError, match=r"a\.jpg: size: got 40 x 24, expected 24 x 40.*EXIF orientation") as caught:
        read_images(coco_of(tmp_path, "a.jpg", SHAPE, [2, 30, 9, 8]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("orientation", every(3, range(2, 9)))
@pytest.mark.parametrize("kind", ["tiff", "tiff, compressed", "png", "tiff of 16 bits"])
def test_places_on_the_moon_follow_the_stored_pixels(tmp_path, kind, orientation):
    """A crater at one stored pixel has one place, however the picture is to be turned."""
    pixels = np.arange(24 * 40, dtype=np.uint8).reshape(24, 40) // 16 * 16
    place = from_origin(1000, 3000, 2, 2)
    path = WRITERS[kind](tmp_path, pixels, orientation)
    a, b, c, d, e, f = tuple(place)[:6]
    world = [a, d, b, e, c + (a + b) / 2, f + (d + e) / 2]
    path.with_suffix(".pgw" if path.suffix == ".png" else ".tfw").write_text("\n".join(map(str, world)))
    path.with_suffix(".prj").write_text(POLAR.to_wkt(version="WKT1_ESRI"))
    reference = read_georeference(path)
    # The stored pixel in column 5 and row 3, as the upright picture shows it.
    mark = np.zeros((24, 40), np.uint8)
    mark[3, 5] = 1
    upright = {o: stored(mark, o) for o in range(1, 9)}[{6: 8, 8: 6}.get(orientation, orientation)]
    (row,), (column,) = np.nonzero(upright)
    a, b, c, d, e, f = reference.transform
    x, y = a * (column + 0.5) + b * (row + 0.5) + c, d * (column + 0.5) + e * (row + 0.5) + f
    assert (x, y) == pytest.approx((1000 + 2 * 5.5, 3000 - 2 * 3.5))
    assert np.isfinite(reference.lon_lat_deg(np.array([[column + 0.5, row + 0.5]]))).all()
