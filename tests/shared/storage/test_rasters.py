"""Rasters are opened by the drivers of documented formats alone, with no file but their own."""

import os
import re
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy
from tests.shared.storage.raster_files import SECRET, isis_cube, isis_detached, pds3, pds4, raw_vrt, tiff

from perilune_shared.errors import UserError
from perilune_shared.storage.rasters import PICTURE_DRIVERS, opened_raster, raster_files

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GROUND = np.arange(3000, dtype="float32").reshape(50, 60)


def read(path, **options):
    with opened_raster(raster_files(path)) as raster:
        return raster.read(1, **options)


@pytest.mark.parametrize("kind", [tiff, pds3, pds4, isis_cube, isis_detached])
def test_documented_formats_are_read(tmp_path, kind):
    path = kind(tmp_path, GROUND)
    assert np.array_equal(read(path), GROUND)


def test_jpeg_2000_and_cloud_optimized(tmp_path):
    whole = GROUND.astype("uint16")
    for name, driver, options in (
        ("a.jp2", "JP2OpenJPEG", {"QUALITY": "100", "REVERSIBLE": "YES"}),
        ("a.tif", "COG", {}),
    ):
        with rasterio.open(
            tmp_path / name, "w", driver=driver, width=60, height=50, count=1, dtype="uint16", **options
        ) as file:
            file.write(whole, 1)
        assert np.array_equal(read(tmp_path / name), whole)


def test_the_data_behind_a_label_belong_to_the_raster(tmp_path):
    for kind in (pds3, pds4, isis_detached):
        folder = tmp_path / kind.__name__
        folder.mkdir()
        path = kind(folder, GROUND)
        assert {file.name for file in raster_files(path).paths} == {file.name for file in folder.iterdir()}


def test_the_data_of_a_label_are_opened_by_the_label(tmp_path):
    pds3(tmp_path, GROUND)
    with pytest.raises(UserError, match=r"open the data through their label, ground\.LBL"):
        raster_files(tmp_path / "ground.IMG")


def test_a_label_of_another_letter_case(tmp_path):
    path = pds3(tmp_path, GROUND)
    (tmp_path / "ground.IMG").rename(tmp_path / "GROUND.img")
    assert np.array_equal(read(path), GROUND)


def test_a_world_file_places_a_raster(tmp_path):
    path = tiff(tmp_path, GROUND)
    path.with_suffix(".tfw").write_text("5\n0\n0\n-5\n102.5\n97.5\n")
    with opened_raster(raster_files(path)) as raster:
        assert raster.transform == rasterio.Affine(5, 0, 100, 0, -5, 100)


@pytest.mark.parametrize(
    "text", ["<VRTDataset rasterXSize='5'/>", "<GDAL_WMS/>", " \n<WMT_MS_Capabilities/>", "<?xml?><a/>"]
)
@pytest.mark.parametrize("name", ["a.tif", "a.vrt", "a.xml", "a.cub"])
def test_text_that_refers_elsewhere_is_refused_under_any_name(tmp_path, text, name):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match="got XML text, which can refer to other files, expected a readable GeoTIFF"):
        raster_files(tmp_path / name)


def test_no_driver_but_the_documented_ones(tmp_path):
    (tmp_path / "a.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n")
    with pytest.raises(UserError, match="got another format"):
        raster_files(tmp_path / "a.asc")
    with rasterio.open(tmp_path / "a.png", "w", driver="PNG", width=60, height=50, count=1, dtype="uint8") as file:
        file.write(GROUND.astype("uint8"), 1)
    with pytest.raises(UserError, match="got PNG, expected"):
        raster_files(tmp_path / "a.png")
    assert raster_files(tmp_path / "a.png", PICTURE_DRIVERS).driver == "PNG"


@pytest.mark.parametrize("suffix", [".ovr", ".msk", ".aux.xml"])
@pytest.mark.parametrize("kind", [tiff, isis_cube, pds3])
def test_sidecars_are_not_read(tmp_path, kind, suffix):
    path = kind(tmp_path, GROUND)
    text = raw_vrt(tmp_path, *((25, 30) if suffix == ".ovr" else (50, 60)))
    if suffix == ".aux.xml":
        (tmp_path / "other.vrt").write_text(text)
        item = f'<MDI key="OVERVIEW_FILE">{tmp_path}/other.vrt</MDI>'
        text = f'<PAMDataset><Metadata domain="OVERVIEWS">{item}</Metadata></PAMDataset>'
    (tmp_path / f"{path.name}{suffix}").write_text(text)
    half = read(path, out_shape=(25, 30), masked=True)
    assert not (half == SECRET).any() and not half.mask.any()


@pytest.mark.parametrize("driver", ["GTiff", "JP2OpenJPEG"])
def test_a_tag_that_names_another_file_is_refused(tmp_path, driver):
    path = tiff(tmp_path, GROUND.astype("uint16"))
    (tmp_path / "other.vrt").write_text(raw_vrt(tmp_path, 25, 30))
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"{tmp_path}/other.vrt")
    if driver != "GTiff":
        copy(path, path := tmp_path / "ground.jp2", driver=driver, WRITE_METADATA="YES")
    with pytest.raises(UserError, match="tags that name another file"):
        read(path)


def test_a_projection_that_names_a_grid_is_refused(tmp_path):
    path = tiff(tmp_path, GROUND, crs=f"+proj=longlat +R=1737400 +nadgrids={tmp_path}/grid.gsb +type=crs")
    with pytest.raises(UserError, match="projection: got nadgrids, which names a file"):
        read(path)


@pytest.mark.parametrize("name", ["../secret.bin", "/etc/passwd", "/vsicurl/http://127.0.0.1:9/a", "..\\a", "sub/a"])
@pytest.mark.parametrize("kind", [pds3, pds4, isis_detached])
def test_a_label_points_into_its_own_folder(tmp_path, kind, name):
    path = kind(tmp_path, GROUND, data=name)
    with pytest.raises(UserError, match=r"label that points to|/vsi"):
        raster_files(path)


@pytest.mark.parametrize("kind", [pds3, pds4, isis_detached])
def test_data_behind_a_label_are_a_file_in_its_folder(tmp_path, kind):
    folder = tmp_path / "a"
    folder.mkdir()
    path = kind(folder, GROUND)
    (data,) = (file for file in folder.iterdir() if file != path)
    data.rename(tmp_path / "elsewhere")
    data.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="a link that leaves the folder"):
        raster_files(path)
    data.unlink()
    os.mkfifo(data)
    with pytest.raises(UserError, match="a folder, a pipe or a device"):
        raster_files(path)


def test_a_pipe_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "a.tif")
    with pytest.raises(UserError, match="a folder, a pipe or a device"):
        raster_files(tmp_path / "a.tif")


def test_no_raster_opens_an_address(tmp_path):
    """A server notes each request; labels, tags, sidecars and text that name it are tried."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/a.tif"
        seen = []
        thread = threading.Thread(target=lambda: seen.append(server.accept()), daemon=True)
        thread.start()
        paths = [kind(_new(tmp_path, kind.__name__), GROUND, data=address) for kind in (pds3, pds4, isis_detached)]
        tagged = tiff(tmp_path, GROUND)
        with rasterio.open(tagged, "r+") as file:
            file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=address)
        source = f"<SimpleSource><SourceFilename>{address}</SourceFilename></SimpleSource>"
        text = (
            f'<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand band="1">{source}</VRTRasterBand></VRTDataset>'
        )
        (tmp_path / "b.tif").write_text(text)
        (sided := tiff(_new(tmp_path, "sided"), GROUND)).with_name("ground.tif.ovr").write_text(text)
        for path in [*paths, tagged, tmp_path / "b.tif"]:
            with pytest.raises(UserError):
                read(path, out_shape=(5, 6))
        assert read(sided, out_shape=(25, 30)).shape == (25, 30)
        assert not seen


def _new(folder, name):
    (folder / name).mkdir()
    return folder / name


def test_a_large_block_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a.tif"
    side = {"width": 20000, "height": 20000, "blockxsize": 20000, "blockysize": 20000}
    with rasterio.open(path, "w", driver="GTiff", count=1, dtype="float32", tiled=True, SPARSE_OK=True, **side):
        pass
    with pytest.raises(UserError, match="got blocks of 20000 x 20000 pixels"):
        read(path)


def test_errors_name_the_raster_and_not_the_temporary_folder(tmp_path):
    path = tiff(tmp_path, GROUND)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(UserError, match=r"ground\.tif: raster: got ") as caught:
        read(path)
    assert "perilune-raster-" not in str(caught.value)


def mosaic(folder, names=("a/ground.tif", "b/ground.tif"), **changes):
    """A VRT of two tiles side by side; `changes` replaces text in it."""
    sources = ""
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(exist_ok=True)
        tiff((folder / name).parent, GROUND + 10 * k)
        place = f'<DstRect xOff="{60 * k}" yOff="0" xSize="60" ySize="50"/>'
        sources += (
            f'<SimpleSource><SourceFilename relativeToVRT="1">{name}</SourceFilename><SourceBand>1</SourceBand>'
            f'<SrcRect xOff="0" yOff="0" xSize="60" ySize="50"/>{place}</SimpleSource>'
        )
    text = (
        '<VRTDataset rasterXSize="120" rasterYSize="50"><GeoTransform>0,5,0,0,0,-5</GeoTransform>'
        f'<VRTRasterBand dataType="Float32" band="1">{sources}</VRTRasterBand></VRTDataset>'
    )
    for old, new in changes.items():
        text = text.replace(old, new)
    (folder / "all.vrt").write_text(text)
    return folder / "all.vrt"


TILES = ("a/ground.tif", "b/ground.tif")


def test_a_vrt_is_read_if_its_tiles_are_listed(tmp_path):
    path = mosaic(tmp_path)
    with pytest.raises(UserError, match=r"XML text.*gdal_translate all\.vrt all\.tif, or list its tiles in vrt_files"):
        raster_files(path)
    files = raster_files(path, tiles=TILES)
    assert [name for name, _ in files.named] == ["all.vrt", *TILES]
    with opened_raster(files) as raster:
        assert np.array_equal(raster.read(1), np.hstack([GROUND, GROUND + 10]))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"b/ground.tif": "c/ground.tif"}, "a VRT that refers to 'c/ground.tif'"),
        ({"b/ground.tif": "../b.tif"}, "a VRT that refers to '../b.tif'"),
        ({"b/ground.tif": "/etc/passwd"}, "a VRT that refers to '/etc/passwd'"),
        ({"b/ground.tif": "/vsicurl/http://127.0.0.1/a.tif"}, "a VRT that refers to"),
        ({'relativeToVRT="1"': 'relativeToVRT="0"'}, "a VRT that refers to"),
        ({' relativeToVRT="1"': ""}, "a VRT that refers to"),
        ({'band="1"': 'band="1" subClass="VRTRawRasterBand"'}, "VRTRasterBand VRTRawRasterBand"),
        ({'band="1"': 'band="1" subClass="VRTDerivedRasterBand"'}, "VRTRasterBand VRTDerivedRasterBand"),
        ({"<SourceBand>": "<OpenOptions><OOI key='a'>b</OOI></OpenOptions><SourceBand>"}, "a VRT with OpenOptions"),
        ({"<GeoTransform>": "<PixelFunctionCode>x</PixelFunctionCode><GeoTransform>"}, "a VRT with PixelFunctionCode"),
        ({"<VRTDataset ": "<!DOCTYPE a [<!ENTITY b SYSTEM '/etc/passwd'>]><VRTDataset "}, "got no VRT"),
        ({"</VRTDataset>": ""}, "no element found"),
    ],
)
def test_a_vrt_that_does_more_than_join_its_tiles_is_refused(tmp_path, changes, text):
    with pytest.raises(UserError, match=text):
        raster_files(mosaic(tmp_path, **changes), tiles=TILES)


def test_tiles_are_rasters_that_refer_to_nothing(tmp_path):
    path = mosaic(tmp_path)
    (tmp_path / "other.vrt").write_text(raw_vrt(tmp_path, 25, 30))
    with rasterio.open(tmp_path / TILES[1], "r+") as file:
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"{tmp_path}/other.vrt")
    with pytest.raises(UserError, match="tags that name another file"):
        raster_files(path, tiles=TILES)
    (tmp_path / TILES[1]).write_text((tmp_path / "other.vrt").read_text())
    with pytest.raises(UserError, match="XML text"):
        raster_files(path, tiles=TILES)
    (tmp_path / TILES[1]).unlink()
    (tmp_path / TILES[1]).symlink_to("/etc/passwd")
    with pytest.raises(UserError, match="a path without links that leave"):
        raster_files(path, tiles=TILES)


@pytest.mark.parametrize("package", ["shared/perilune_shared", "render/perilune_render"])
def test_no_other_module_reads_rasters(package):
    root = Path(__file__).parents[3]
    reads = re.compile(r"(?:rasterio|gdal)\.open\((?![^)]*\"w\")|WarpedVRT|rasterio\.shutil", re.I)
    found = [path for path in (root / package).rglob("*.py") if reads.search(path.read_text(encoding="utf-8"))]
    assert [path.name for path in found if path.name != "rasters.py"] == []
    assert reads.search("with rasterio.open(path) as raster:") and not reads.search(
        'rasterio.open(aside, "w", **profile)'
    )
