"""Videos and TIFF files of several pages: one image per frame."""

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from tests.helpers import in_process
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.images import sequences
from perilune_train.detect.images.predict import PredictSettings, predict_images
from perilune_train.detect.images.read import read_grey
from perilune_train.detect.images.sequences import frames_of
from perilune_train.detect.inference.tiling import Tiling


def noise(height, width, seed=5):
    return np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)


def write_video(path, frames, codec="FFV1"):
    height, width = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, (width, height), False)
    if not writer.isOpened():
        pytest.skip(f"OpenCV writes no {codec}")
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "FFV1"), ("a.mkv", "FFV1"), ("a.mp4", "mp4v")])
def test_the_frames_of_a_video(tmp_path, name, codec):
    frames = [cv2.GaussianBlur(noise(48, 64, seed), (0, 0), 3) for seed in range(4)]
    paths = frames_of(write_video(tmp_path / name, frames, codec), tmp_path)
    assert [path.name for path in paths] == [f"{name}.{number:06d}.png" for number in range(4)]
    for path, frame in zip(paths, frames, strict=True):
        # A lossless codec changes grey levels by the rounding of colours.
        assert np.abs(read_grey(path).astype(int) - frame).max() <= (3 if codec == "FFV1" else 40)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_the_pages_of_a_tiff(tmp_path, kind):
    pages = [(noise(40, 50, seed).astype(kind) * (200 if kind == np.uint16 else 1)).astype(kind) for seed in range(3)]
    first, *others = (Image.fromarray(page) for page in pages)
    first.save(tmp_path / "a.tif", save_all=True, append_images=others)
    for number, path in enumerate(frames_of(tmp_path / "a.tif", tmp_path)):
        assert path.name == f"a.tif.{number:06d}.tif"
        Image.fromarray(pages[number]).save(tmp_path / "alone.tif")
        assert (read_grey(path) == read_grey(tmp_path / "alone.tif")).all()
    assert number == 2


def test_overviews_and_masks_are_no_frames(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", height=512, width=512, count=1, dtype="uint8") as file:
        file.write(noise(512, 512), 1)
        file.build_overviews([2, 4])
        file.write_mask(np.full((512, 512), True))
    assert frames_of(tmp_path / "a.tif", tmp_path) is None


def test_a_table_has_rows_of_each_frame(tmp_path):
    run = store_run(tmp_path / "runs")
    path = write_video(tmp_path / "a.avi", [noise(70, 100, seed) for seed in range(3)])
    cv2.imwrite(str(tmp_path / "b.png"), noise(70, 100))
    settings = PredictSettings(Tiling(tile_px=96, overlap_px=32))
    count = predict_images([path, tmp_path / "b.png"], run, settings_of(run), tmp_path / "out", settings)
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    names = {*(f"a.avi.{number:06d}.png" for number in range(3)), "b.png"}
    assert len(table) == count and set(table["image"]) == names
    assert {path.name for path in (tmp_path / "out").glob("*.overlay.png")} == {f"{name}.overlay.png" for name in names}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "another kind of file"),
        (b"#EXTM3U\n#EXTINF:1,\nhttp://192.0.2.1/a.ts\n", "another kind of file"),
        (b"\0\0\0\x18ftypmp42" + bytes(200), "no frame that OpenCV can decode"),
        (b"RIFF" + bytes(range(200)), "no frame that OpenCV can decode"),
        (None, "No such file"),
    ],
)
def test_a_file_that_is_no_video_is_refused_in_one_line(tmp_path, content, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / "a.mp4").write_bytes(content)
    done = in_process.call(main, "detect", "predict", "a.mp4", "--out", "out")
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and message in line and line.endswith("or its frames: ffmpeg -i a.mp4 %06d.png")
    assert not (tmp_path / "out").exists()


def test_too_many_pixels_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sequences, "_MAX_PIXELS", 10_000)
    path = write_video(tmp_path / "a.avi", [noise(48, 64)] * 4)
    with pytest.raises(UserError, match=r"got more than 10000, expected at most 10000; take fewer frames: ffmpeg -i a"):
        frames_of(path, tmp_path)
    first, *others = [Image.fromarray(noise(60, 60))] * 3
    first.save(tmp_path / "a.tif", save_all=True, append_images=others)
    with pytest.raises(UserError, match="got more than 10000"):
        frames_of(tmp_path / "a.tif", tmp_path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("width", [10_000, 20_000])
def test_a_large_tiff_of_one_page_is_one_picture(tmp_path, width):
    """Pillow warns of 10^8 pixels and refuses twice as many; the reader of pictures has its own limits."""
    path = tmp_path / "large.tif"
    Image.new("1", (width, 10_000)).save(path, compression="group4")
    assert frames_of(path, tmp_path) is None
