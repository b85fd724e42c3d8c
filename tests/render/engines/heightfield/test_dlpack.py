"""Arrays handed to other libraries by DLPack, tested in the memory of the processor."""

import gc
import weakref

import numpy as np
import pytest

from perilune_render.engines.heightfield.dlpack import _LENT, CPU, SharedArray


class Kept(np.ndarray):
    """An array that can be referred to weakly."""


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, np.int64])
def test_numpy_reads_the_same_memory(dtype):
    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    shared = SharedArray(array)
    assert shared.__dlpack_device__() == (CPU, 0)
    other = np.from_dlpack(shared)
    np.testing.assert_array_equal(other, array)
    array[1, 2, 3] = 99
    assert other[1, 2, 3] == 99 and other.dtype == dtype


def test_torch_reads_the_same_memory():
    torch = pytest.importorskip("torch")
    array = np.ones((3, 5), np.float32)
    tensor = torch.from_dlpack(SharedArray(array))
    tensor[2, 4] = 7
    assert array[2, 4] == 7 and tensor.shape == (3, 5)


def test_memory_lives_as_long_as_it_is_used():
    array = np.ones(10_000, np.float32).view(Kept)
    alive = weakref.ref(array)
    other = np.from_dlpack(SharedArray(array))
    del array
    gc.collect()
    assert alive() is not None and other.sum() == 10_000
    del other
    gc.collect()
    assert alive() is None


def test_a_capsule_that_nobody_uses_ends_with_its_memory():
    before = len(_LENT)
    capsule = SharedArray(np.ones(4)).__dlpack__()
    assert len(_LENT) == before + 1
    del capsule
    gc.collect()
    assert len(_LENT) == before
