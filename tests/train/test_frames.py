import cv2
import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_train.data.frames import read_image


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_a_16_bit_frame_has_the_range_of_an_8_bit_one(tmp_path, bits):
    """A grey value of more than 8 bits stands in the upper bits of 16 (docs/dataset.md)."""
    grey = np.arange(256, dtype=np.uint16).reshape(16, 16)
    cv2.imwrite(str(tmp_path / "8.png"), grey.astype(np.uint8))
    fine = grey * 2 ** (bits - 8) + 2 ** (bits - 8) - 1
    assert fine.max() == 2**bits - 1
    cv2.imwrite(str(tmp_path / "fine.png"), fine << (16 - bits))
    for name in ("8.png", "fine.png"):
        image = read_image(tmp_path / name, 16, 16)
        assert image.dtype == np.uint8 and np.array_equal(image, grey)


def test_a_frame_that_is_no_image_is_refused(tmp_path):
    (tmp_path / "0.png").write_bytes(b"no image")
    with pytest.raises(UserError, match="does not decode"):
        read_image(tmp_path / "0.png", 16, 16)
