"""Pictures of every depth and layout, with pixels that hold no data."""

import sys

import cv2
import numpy as np
import pytest
import rasterio

from perilune_shared.errors import UserError
from perilune_train.detect.images.read import picture_size, read_grey

ISIS_NULL = -3.4028226550889045e38


def ramp(height=20, width=30):
    """Values from 1000 to 1255, each row another."""
    return 1000.0 + np.random.default_rng(2).permutation(height * width).reshape(height, width) * 255 / 599


def tiff(path, bands, dtype, **more):
    bands = np.asarray(bands).reshape(-1, *np.shape(bands)[-2:]).astype(dtype)
    count, height, width = bands.shape
    with rasterio.open(
        path, "w", driver="GTiff", height=height, width=width, count=count, dtype=dtype, **more
    ) as image:
        image.write(bands)
    return path


@pytest.mark.parametrize(
    ("dtype", "nodata", "reported"),
    [
        ("float32", ISIS_NULL, None),
        ("float32", ISIS_NULL, ISIS_NULL),
        ("float32", np.inf, None),
        ("float32", -9999.0, -9999.0),
        ("float32", -9999.1, -9999.1),
        ("float64", ISIS_NULL, None),
        ("float64", -9999.0, -9999.0),
        ("float64", 1e300, 1e300),
        ("int16", -32768, -32768),
        ("uint16", 65535, 65535),
    ],
)
def test_pixels_without_data_are_black_and_leave_the_rest_its_range(tmp_path, dtype, nodata, reported):
    pixels = ramp()
    pixels[:8] = nodata
    path = tiff(tmp_path / "n.tif", pixels, dtype, nodata=reported)
    read = read_grey(path)
    assert (read[:8] == 0).all()
    rest = read[8:]
    assert (rest.min(), rest.max()) == (0, 255) and len(np.unique(rest)) > 150
    assert np.corrcoef(rest.ravel(), pixels[8:].ravel())[0, 1] > 0.9999


def test_odd_words_for_no_data_are_passed_over(tmp_path):
    for word in ("nan", "-inf", "1e400"):
        assert np.ptp(read_grey(tiff(tmp_path / f"{word}.tif", ramp(), "float32", nodata=float(word)))) == 255
    # 16 characters of which the tag is made, none of them a number.
    path = tiff(tmp_path / "w.tif", ramp(), "float32", nodata=-12345.0)
    path.write_bytes(path.read_bytes().replace(b"-12345", b"absent"))
    assert np.ptp(read_grey(path)) == 255


def test_a_picture_that_holds_no_data_at_all(tmp_path):
    assert not read_grey(tiff(tmp_path / "n.tif", np.full((9, 9), -1.0), "float32", nodata=-1.0)).any()


@pytest.mark.parametrize("interleave", ["pixel", "band"])
@pytest.mark.parametrize("dtype", ["uint16", "float32", "float64"])
def test_deep_colours_are_stretched_as_their_luma(tmp_path, dtype, interleave):
    # The darkest of the 256 levels of 16 bits: of the upper 8 bits nothing would be left.
    colours = np.random.default_rng(3).integers(0, 256, (3, 20, 30))
    path = tiff(tmp_path / "c.tif", colours, dtype, photometric="RGB", interleave=interleave)
    luma = np.tensordot([0.299, 0.587, 0.114], colours, 1)
    read = read_grey(path)
    assert picture_size(path) == (30, 20)
    assert (read.min(), read.max()) == (0, 255)
    assert np.corrcoef(read.ravel(), luma.ravel())[0, 1] > 0.9999


@pytest.mark.parametrize("count", [3, 4])
def test_deep_colours_in_png(tmp_path, count):
    colours = np.random.default_rng(4).integers(0, 256, (20, 30, count)).astype(np.uint16)
    path = tmp_path / "c.png"
    assert cv2.imwrite(str(path), colours)
    luma = colours[..., :3] @ [0.114, 0.587, 0.299]
    assert np.corrcoef(read_grey(path).ravel(), luma.ravel())[0, 1] > 0.9999
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"c\.png: image"):
        read_grey(path)


@pytest.mark.parametrize(("dtype", "bands"), [("uint16", 1), ("uint16", 2), ("int32", 2), ("float64", 1)])
def test_of_bands_that_are_no_colours_the_first_counts(tmp_path, dtype, bands):
    pixels = np.stack([ramp(), np.random.default_rng(5).permutation(ramp())])[:bands]
    read = read_grey(tiff(tmp_path / "b.tif", pixels, dtype))
    assert np.corrcoef(read.ravel(), pixels[0].ravel())[0, 1] > 0.9999


def test_8_bits_of_more_bands_stay_as_they_are(tmp_path):
    grey = ramp().astype(np.uint8) // 2
    for bands, options in ((2, {}), (1, {"compress": "LERC"}), (3, {"photometric": "RGB", "compress": "LERC"})):
        read = read_grey(tiff(tmp_path / f"{bands}.tif", [grey] * bands, "uint8", **options))
        assert np.array_equal(read, grey)


def test_what_stays_unread_is_told_in_one_line(tmp_path, monkeypatch, capfd):
    whole = tiff(tmp_path / "f.tif", ramp(300, 300), "float64")
    cut = tmp_path / "cut.tif"
    cut.write_bytes(whole.read_bytes()[:9000])
    with pytest.raises(UserError, match=r"cut\.tif: image"):
        read_grey(cut)
    with pytest.raises(UserError, match=r"z\.tif: image: got complex numbers"):
        read_grey(tiff(tmp_path / "z.tif", ramp(), "complex64"))
    with pytest.raises(UserError, match="image: got a folder"):
        read_grey(tmp_path)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(UserError, match=r"cannot be decoded, expected .* rasterio, which reads all \(pip"):
        picture_size(whole)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compress", [None, "deflate", "lerc"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "uint32", "float32"])
def test_pictures_in_which_white_is_zero_are_inverted(tmp_path, dtype, compress):
    pixels = ramp().astype(dtype) if dtype != "uint8" else (ramp() - 1000).astype(dtype)
    options = {"compress": compress} if compress else {}
    read = read_grey(tiff(tmp_path / "w.tif", pixels, dtype, photometric="MINISWHITE", **options))
    assert np.corrcoef(read.ravel(), pixels.astype(float).ravel())[0, 1] < -0.9999
    assert (read.min(), read.max()) == (0, 255)


def test_missing_pixels_of_a_picture_in_which_white_is_zero_are_black(tmp_path):
    pixels = ramp()
    pixels[:4] = -1
    assert not read_grey(tiff(tmp_path / "w.tif", pixels, "int16", photometric="MINISWHITE", nodata=-1))[:4].any()


@pytest.mark.parametrize("without_rasterio", [False, True])
def test_white_is_zero_and_large_numbers_without_rasterio(tmp_path, monkeypatch, without_rasterio):
    white = tiff(tmp_path / "w.tif", ramp(), "uint16", photometric="MINISWHITE")
    large = tiff(tmp_path / "l.tif", ramp() + (2**31 - 1100), "uint32")
    if without_rasterio:
        monkeypatch.setitem(sys.modules, "rasterio", None)
    assert np.corrcoef(read_grey(white).ravel(), ramp().ravel())[0, 1] < -0.9999
    assert np.corrcoef(read_grey(large).ravel(), ramp().ravel())[0, 1] > 0.9999


@pytest.mark.parametrize(("dtype", "offset"), [("uint32", 2**32 - 2000), ("int32", -(2**31)), ("int8", -1128)])
def test_numbers_at_the_ends_of_their_type(tmp_path, dtype, offset):
    read = read_grey(tiff(tmp_path / "n.tif", np.floor(ramp()) + offset, dtype))
    assert np.corrcoef(read.ravel(), ramp().ravel())[0, 1] > 0.9999 and np.ptp(read) == 255


@pytest.mark.parametrize(
    ("dtype", "fills"),
    [
        ("float32", [-9999.0]),
        ("float64", [1e20]),
        ("float32", [-32768.0, -9999.0]),
        ("int16", [-32768, -32767, -32765]),
        ("uint16", [65535]),
        ("uint16", [0, 65535]),
    ],
)
def test_undeclared_values_of_missing_pixels_leave_the_rest_its_range(tmp_path, capsys, dtype, fills):
    pixels = ramp()
    for k, fill in enumerate(fills):
        pixels[2 * k : 2 * k + 2] = fill
    n = 2 * len(fills)
    path = tiff(tmp_path / "u.tif", pixels, dtype)
    read = read_grey(path)
    said = " ".join(capsys.readouterr().err.split())
    assert "u.tif: " in said and f"{len(fills) * 10}.0% of the pixels are" in said and "--nodata" in said
    assert not read[:n].any()
    assert np.corrcoef(read[n:].ravel(), pixels[n:].ravel())[0, 1] > 0.9999
    # The same value given by the user needs no line.
    if len(fills) == 1:
        assert np.array_equal(read_grey(path, nodata=fills[0]), read)
        assert capsys.readouterr().err == ""


def test_a_given_value_of_missing_pixels_holds_for_every_depth(tmp_path):
    pixels = ramp()
    pixels[:5] = 1100.5
    read = read_grey(tiff(tmp_path / "n.tif", pixels, "float32"), nodata=1100.5)
    assert not read[:5].any() and np.corrcoef(read[5:].ravel(), pixels[5:].ravel())[0, 1] > 0.9999
    grey = np.full((9, 9), 200, np.uint8)
    grey[0] = 255
    read = read_grey(tiff(tmp_path / "g.tif", grey, "uint8"), nodata=255)
    assert not read[0].any() and (read[1:] == 200).all()


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_bright_and_dark_ground_is_not_taken_as_missing(tmp_path, capsys, dtype):
    """Shadows of one value, and saturated slopes, near the rest of the range."""
    pixels = ramp()
    pixels[:4], pixels[4:6] = 990, 1300
    read = read_grey(tiff(tmp_path / "s.tif", pixels, dtype))
    assert capsys.readouterr().err == "" and (read[:4] == 0).all() and (read[4:6] == 255).all()
