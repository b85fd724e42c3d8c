"""Elevation models from outside: what they refer to, what they decode to, and the memory that they take."""

import contextlib
import os

import numpy as np
import pytest
import rasterio

import perilune_render.preview.contact_sheet
import perilune_render.terrain.export
from perilune_render.cli.main import main
from perilune_render.terrain.elevation.model import read_elevation
from perilune_render.terrain.elevation.window import LARGEST_PIXELS
from tests.helpers.elevation_models import POLAR, rough, write
from tests.hostile.measured import accepted, refused
from tests.shared.storage.raster_files import isis_detached, pds3, pds4

SMALL = ["--preset=tiny", "--kind=detect", "--set=dataset.camera.width_px=32", "--set=dataset.camera.height_px=32"]
SMALL += ["--set=dataset.terrain.spacing_px=4", "--set=dataset.render.engine=heightfield"]
PLACED = rasterio.Affine(5, 0, -75840, 0, -5, 75840)
GROUND = np.arange(3000, dtype="float32").reshape(50, 60)


@pytest.fixture(autouse=True, scope="module")
def loaded(tmp_path_factory):
    """Libraries that the first model loads count neither as memory nor as time."""
    folder = tmp_path_factory.mktemp("first")
    model = read_elevation(write(folder / "a.tif", rough(), POLAR, rasterio.Affine(5, 0, 1e5, 0, -5, 0)))
    assert model.known.all() and perilune_render.preview.contact_sheet and perilune_render.terrain.export


def sparse(path, side, **options):
    """A raster without a stored pixel."""
    options = {"dtype": "float32", "tiled": True, "compress": "lzw", "bigtiff": "yes"} | options
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=side,
        height=side,
        count=1,
        crs=POLAR,
        transform=PLACED,
        SPARSE_OK=True,
        **options,
    ):
        pass
    return path


def export(dem, out, *more):
    return ["ground", *SMALL, "--dem", dem, *more, "--out", out]


def test_a_polar_product_of_30336_pixels_takes_the_memory_of_the_scene(tmp_path):
    dem = sparse(tmp_path / "polar.tif", 30336)
    accepted("30336 x 30336 pixels", main, *export(dem, tmp_path / "a.tif"), memory_mb=600)
    accepted(
        "30336 x 30336 pixels of float64",
        main,
        *export(sparse(tmp_path / "b.tif", 30336, dtype="float64"), tmp_path / "b.glb"),
        memory_mb=600,
    )


def test_a_preview_of_a_polar_product(tmp_path):
    dem = sparse(tmp_path / "polar.tif", 30336)
    accepted(
        "preview of 30336 x 30336", main, "preview", *SMALL, "--dem", dem, "--out", tmp_path / "p.png", memory_mb=1200
    )


def test_the_largest_model_that_is_read_whole(tmp_path):
    side = int(np.sqrt(LARGEST_PIXELS))
    height = np.resize(rough(n=512), (side, side)).round()
    height[::64] = -9999
    dem = write(tmp_path / "a.tif", height, POLAR, PLACED, compress="deflate")
    accepted("the largest model read whole", main, *export(dem, tmp_path / "a.tif"), memory_mb=2000, limit_s=300)


def test_a_bomb_of_one_block(tmp_path):
    dem = sparse(tmp_path / "a.tif", 40_000, blockxsize=40_000, blockysize=40_000)
    refused("one block of 6.4 GB", main, *export(dem, tmp_path / "a.tif"), naming="blocks of 40000 x 40000 pixels")


def test_many_bands(tmp_path):
    with rasterio.open(
        tmp_path / "a.tif",
        "w",
        driver="GTiff",
        width=2000,
        height=2000,
        count=3000,
        dtype="float32",
        crs=POLAR,
        transform=PLACED,
        SPARSE_OK=True,
        tiled=True,
        interleave="pixel",
        bigtiff="yes",
    ):
        pass
    refused("3000 bands", main, *export(tmp_path / "a.tif", tmp_path / "b.tif"), naming="bands", memory_mb=800)


@pytest.mark.parametrize(
    "text",
    [
        "<VRTDataset rasterXSize='5' rasterYSize='5'><VRTRasterBand band='1'><SimpleSource><SourceFilename>/etc/passwd"
        "</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
        "<GDAL_WMS><Service name='TMS'><ServerUrl>http://127.0.0.1:9/a</ServerUrl></Service></GDAL_WMS>",
        "<WMT_MS_Capabilities/>",
        "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n",
        "{'type': 'FeatureCollection'}",
        "",
    ],
)
@pytest.mark.parametrize("name", ["a.tif", "a.vrt", "a.lbl"])
def test_text_of_other_drivers(tmp_path, text, name):
    (tmp_path / name).write_text(text)
    refused(f"text as {name}", main, *export(tmp_path / name, tmp_path / "b.tif"), naming="expected a readable GeoTIFF")


@pytest.mark.parametrize("name", ["../a.IMG", "/dev/zero", "/vsicurl/http://127.0.0.1:9/a", "pipe"])
@pytest.mark.parametrize("kind", [pds3, pds4, isis_detached])
def test_labels_that_point_elsewhere(tmp_path, kind, name):
    os.mkfifo(tmp_path / "pipe")
    path = kind(tmp_path, GROUND, data=name)
    naming = "a pipe or a device" if name == "pipe" else "a label "
    refused(f"{kind.__name__} of {name}", main, *export(path, tmp_path / "b.tif"), naming=naming, limit_s=20)


def test_a_pipe_and_a_device(tmp_path):
    os.mkfifo(tmp_path / "a.tif")
    for path in (tmp_path / "a.tif", "/dev/zero", tmp_path):
        refused(f"{path}", main, *export(path, tmp_path / "b.tif"), naming="a folder, a pipe or a device", limit_s=20)


def test_damaged_files_are_one_line(tmp_path):
    """Bytes of each format are changed at random: it is read, or refused in one line."""
    rng = np.random.default_rng(5)
    whole = write(tmp_path / "a.tif", rough(n=60), POLAR, PLACED, compress="deflate").read_bytes()
    for k in range(20):
        data = bytearray(whole)
        for place in rng.integers(0, 600, 12):
            data[place] = rng.integers(256)
        (tmp_path / "b.tif").write_bytes(data[: rng.integers(300, len(data))] if k % 4 == 0 else data)
        with contextlib.suppress(AssertionError):
            accepted(f"damaged {k}", main, *export(tmp_path / "b.tif", tmp_path / "c.tif"), memory_mb=800)
            continue
        refused(f"damaged {k}", main, *export(tmp_path / "b.tif", tmp_path / "c.tif"), naming="expected", memory_mb=800)
