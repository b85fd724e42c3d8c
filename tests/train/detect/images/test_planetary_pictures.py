"""ISIS cubes, PDS and JPEG 2000, which rasterio reads."""

import sys

import numpy as np
import pandas as pd
import pytest
import rasterio
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.errors import UserError
from perilune_train.detect.images.pictures import pictures_of
from perilune_train.detect.images.predict import PredictSettings, predict_images
from perilune_train.detect.images.read import picture_size, read_grey
from perilune_train.detect.inference.tiling import Tiling

HEIGHT, WIDTH = 70, 96
KINDS = ["cub", "jp2", "xml", "IMG", "LBL"]
LABEL = """PDS_VERSION_ID = PDS3\r
RECORD_TYPE = FIXED_LENGTH\r
RECORD_BYTES = {record}\r
{pointer}\r
OBJECT = IMAGE\r
 LINES = {height}\r
 LINE_SAMPLES = {width}\r
 SAMPLE_TYPE = MSB_INTEGER\r
 SAMPLE_BITS = 16\r
 MISSING_CONSTANT = -32768\r
END_OBJECT = IMAGE\r
END\r
"""


def values():
    ground = np.random.default_rng(3).permutation(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) // 8 + 500
    return ground.astype(np.int16)


def written(folder, kind):
    """A picture of 16 bits in one of the formats, with `values` as pixels."""
    path = folder / f"p.{kind}"
    drivers = {"cub": "ISIS3", "jp2": "JP2OpenJPEG", "xml": "PDS4"}
    options = {"jp2": {"QUALITY": "100", "REVERSIBLE": "YES"}}.get(kind, {})
    if kind in drivers:
        with rasterio.open(
            path, "w", driver=drivers[kind], width=WIDTH, height=HEIGHT, count=1, dtype="int16", **options
        ) as image:
            image.write(values(), 1)
        return path
    raw = values().astype(">i2").tobytes()
    sizes = {"record": 2 * WIDTH, "height": HEIGHT, "width": WIDTH}
    if kind == "LBL":
        path.write_bytes(LABEL.format(pointer='^IMAGE = "P.IMG"', **sizes).encode())
        (folder / "P.IMG").write_bytes(raw)
        return path
    head = LABEL.format(pointer="^IMAGE = 5", **sizes).encode()
    path.write_bytes(head.ljust(4 * 2 * WIDTH) + raw)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_are_those_of_the_file(tmp_path, kind):
    path = written(tmp_path, kind)
    read = read_grey(path)
    assert picture_size(path) == (WIDTH, HEIGHT)
    assert (read.min(), read.max()) == (0, 255)
    assert np.corrcoef(read.ravel(), values().ravel())[0, 1] > 0.9999


@pytest.mark.parametrize("kind", KINDS)
def test_without_rasterio_they_are_refused_in_one_line(tmp_path, monkeypatch, kind):
    path = written(tmp_path, kind)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(UserError, match=r"without rasterio, expected rasterio, .*perilune-train\[geo\]"):
        read_grey(path)


def test_a_folder_of_them(tmp_path):
    """The data of a detached label are opened by it, and listed once."""
    root = tmp_path / "set"
    for kind in ("cub", "jp2", "LBL"):
        (root / kind).mkdir(parents=True)
        written(root / kind, kind)
    assert [path.name for path in pictures_of(root / "LBL")] == ["p.LBL"]
    assert [path.name for path in pictures_of(root, recursive=True)] == ["p.LBL", "p.cub", "p.jp2"]
    run = store_run(tmp_path / "runs")
    folders = [root / kind for kind in ("cub", "jp2", "LBL")]
    settings = PredictSettings(Tiling(tile_px=96))
    count = predict_images(folders, run, settings_of(run), tmp_path / "out", settings)
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    assert len(table) == count > 0 and set(table["image"]) == {"p.cub", "p.jp2", "p.LBL"}
