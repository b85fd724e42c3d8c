import json
import os
import shutil
import struct
import zlib

import cv2
import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.data.frames import decode, load_frames


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_a_16_bit_frame_has_the_range_of_an_8_bit_one(tmp_path, bits):
    """A grey value of more than 8 bits stands in the upper bits of 16 (docs/reference/dataset.md)."""
    grey = np.arange(256, dtype=np.uint16).reshape(16, 16)
    cv2.imwrite(str(tmp_path / "8.png"), grey.astype(np.uint8))
    fine = grey * 2 ** (bits - 8) + 2 ** (bits - 8) - 1
    assert fine.max() == 2**bits - 1
    cv2.imwrite(str(tmp_path / "fine.png"), fine << (16 - bits))
    for name in ("8.png", "fine.png"):
        image = decode((tmp_path / name).read_bytes(), name, 16, 16)
        assert image.dtype == np.uint8 and np.array_equal(image, grey)


def bomb(width, height):
    """A PNG that says it is large, and holds nothing."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + bytes(12)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"no image", "not a PNG"), (bomb(60_000, 60_000), "60000 x 60000"), (bomb(16, 16), "cannot be decoded")],
)
def test_a_frame_that_is_no_image_is_refused(content, message):
    with pytest.raises(UserError, match=message):
        decode(content, "0.png", 16, 16)


def test_a_frame_that_is_cut_short_is_refused(few, tmp_path):
    """Without its last chunk, the 12 bytes of IEND, a decoder may still return all pixels."""
    root = shutil.copytree(few, tmp_path / "cut")
    dataset = open_dataset(root)
    name = dataset.table("frames", ["png_path"], split="train")["png_path"][0].as_py()
    whole = (root / name).read_bytes()
    (root / name).write_bytes(whole[:-12])
    with pytest.raises(UserError) as told:
        load_frames(dataset, "train")
    assert f"{root}/{name}: png_bytes: got {len(whole) - 12} bytes, expected {len(whole)} bytes" in str(told.value)
    assert "perilune-manifest validate" in str(told.value)


def test_frames_that_no_memory_holds_are_refused(few, tmp_path, monkeypatch):
    """A few bytes of dataset.json and of PNG can ask for any room. On a machine of 512 MiB."""
    root = shutil.copytree(few, tmp_path / "bomb")
    path = root / "dataset.json"
    content = json.loads(path.read_text())
    content["camera"].update(width_px=11_500, height_px=11_500)
    path.write_text(json.dumps(content))
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**17}.__getitem__)
    with pytest.raises(UserError, match=r"6 frames of 11500 x 11500 pixels, 0\.7 GiB"):
        load_frames(open_dataset(root), "train")
