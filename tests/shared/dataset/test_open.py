"""Reading a dataset in Python: tables as pandas, frames by row number or frame_id."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import perilune_shared as ps
from perilune_shared.errors import UserError


@pytest.mark.parametrize("name", ["crowded", "crowded_packed"])
def test_tables_and_frames(name, request):
    dataset = ps.open_dataset(request.getfixturevalue(name))
    assert len(dataset) == len(dataset.frames) == dataset.info.counts.frames > 2
    assert len(dataset.labels) == dataset.info.counts.labels > 0
    assert set(dataset.frames["scene_id"]) == set(dataset.scenes["scene_id"])
    for place in (0, 1, -1):
        frame = dataset[place]
        row = dataset.frames.iloc[place]
        assert frame.frame_id == row["frame_id"] and np.array_equal(frame.row["position_m"], row["position_m"])
        own = dataset.labels[dataset.labels["frame_id"] == frame.frame_id]
        assert len(own) and frame.labels["crater_id"].tolist() == own["crater_id"].tolist()
        decoded = cv2.imdecode(np.frombuffer(frame.png, np.uint8), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(frame.image, decoded) and frame.image.dtype == decoded.dtype
        assert dataset[frame.frame_id].png == frame.png


def test_missing_frames_raise_an_error(crowded):
    dataset = ps.open_dataset(crowded)
    for place in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError):
            dataset[place]
    with pytest.raises(KeyError, match="scene-9"):
        dataset["scene-9/trajectory-0/000000"]
    with pytest.raises(AttributeError, match="open_datasets"):
        _ = ps.open_datasets


def huge(png):
    """Return the PNG with a header of 65,536 x 65,536 pixels."""
    return png[:16] + (65536).to_bytes(4, "big") * 2 + png[24:]


@pytest.mark.parametrize("damage", [lambda _: b"no picture", lambda png: png[: len(png) // 2], huge])
def test_an_invalid_image_error_names_the_frame(victim, damage):
    dataset = ps.open_dataset(victim)
    path = victim / dataset.frames["png_path"][0]
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=dataset.frames["frame_id"][0]):
        _ = dataset[0].image


def test_a_frame_without_its_last_bytes_is_refused(victim):
    dataset = ps.open_dataset(victim)
    path = victim / dataset.frames["png_path"][0]
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-12])  # the end mark: all pixels are there
    with pytest.raises(UserError, match=f"png_bytes: got {size - 12} bytes, expected {size} bytes"):
        _ = dataset[0].image


def test_16_bit_frames_keep_all_bits(victim):
    dataset = ps.open_dataset(victim)
    path = victim / dataset.frames["png_path"][0]
    deep = np.arange(32 * 32, dtype=np.uint16).reshape(32, 32) * 60
    path.write_bytes(cv2.imencode(".png", deep)[1].tobytes())
    frame = dataset[0]
    frame = replace(frame, row={**frame.row, "png_bytes": len(frame.png)})
    assert np.array_equal(frame.image, deep) and frame.image.dtype == np.uint16
