"""Arrays on a CUDA device that torch, JAX and CuPy take over without a copy: DLPack, version 0.

numba's arrays have the CUDA array interface, which torch and CuPy read; `torch.from_dlpack` and JAX need DLPack. The
structures are those of dlpack.h (https://dmlc.github.io/dlpack/latest/c_api.html).
"""

import ctypes
from typing import Any

import numpy as np

CPU, CUDA = 1, 2
"""Kinds of devices of dlpack.h."""
_CODES = {"i": 0, "u": 1, "f": 2}


class _Device(ctypes.Structure):
    _fields_ = [("kind", ctypes.c_int32), ("number", ctypes.c_int32)]


class _DataType(ctypes.Structure):
    _fields_ = [("code", ctypes.c_uint8), ("bits", ctypes.c_uint8), ("lanes", ctypes.c_uint16)]


class _Tensor(ctypes.Structure):
    _fields_ = [
        ("data", ctypes.c_void_p), ("device", _Device), ("n_dimensions", ctypes.c_int32), ("data_type", _DataType),
        ("shape", ctypes.POINTER(ctypes.c_int64)), ("strides", ctypes.POINTER(ctypes.c_int64)),
        ("offset", ctypes.c_uint64),
    ]  # fmt: skip


class _ManagedTensor(ctypes.Structure):
    pass


_Deleter = ctypes.CFUNCTYPE(None, ctypes.POINTER(_ManagedTensor))
_ManagedTensor._fields_ = [("tensor", _Tensor), ("context", ctypes.c_void_p), ("delete", _Deleter)]
_Destructor = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_LENT: dict[int, Any] = {}
"""Tensors that a consumer may still use, and what keeps their memory, by the address of the tensor."""
# New objects, since the functions in ctypes.pythonapi are shared and other libraries change their argument types.
_new_capsule = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_char_p, _Destructor)(
    ("PyCapsule_New", ctypes.pythonapi)
)
_is_unused = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_char_p)(("PyCapsule_IsValid", ctypes.pythonapi))
_address_in = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)
_NAME = b"dltensor"


@_Deleter
def _delete(managed: Any) -> None:
    """Called by the consumer that no longer needs the tensor."""
    _LENT.pop(ctypes.addressof(managed.contents), None)


@_Destructor
def _destroy(capsule: int) -> None:
    """Called at the end of a capsule. A consumer renames a capsule that it uses; `_delete` then ends the tensor."""
    if _is_unused(capsule, _NAME):
        _LENT.pop(_address_in(capsule, _NAME), None)


class SharedArray:
    """A contiguous array of numba on a CUDA device, or in its simulator, with DLPack and the CUDA array interface."""

    def __init__(self, array: Any):
        """`array` is a device array of numba, or a NumPy array."""
        self.array = array
        self.shape, self.dtype = tuple(array.shape), np.dtype(array.dtype)
        host = array if isinstance(array, np.ndarray) else getattr(array, "_ary", None)
        if host is None:
            self._address, self._device = array.__cuda_array_interface__["data"][0], (CUDA, _number_of_device())
        else:
            # numba's simulator keeps its arrays in the memory of the processor.
            self._address, self._device = host.ctypes.data, (CPU, 0)

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        if self._device[0] != CUDA:
            raise AttributeError("__cuda_array_interface__: the array is in the memory of the processor")
        return dict(self.array.__cuda_array_interface__)

    def __dlpack_device__(self) -> tuple[int, int]:
        """Kind and number of the device."""
        return self._device

    def __dlpack__(self, *, stream: Any = None, **_: Any) -> Any:
        """A capsule of the array; it keeps the memory until the consumer releases it."""
        if self._device[0] == CUDA:
            from numba import cuda

            # The consumer may use another stream of the device.
            cuda.synchronize()
        shape = (ctypes.c_int64 * len(self.shape))(*self.shape)
        data_type = _DataType(_CODES[self.dtype.kind], 8 * self.dtype.itemsize, 1)
        tensor = _Tensor(self._address, _Device(*self._device), len(self.shape), data_type, shape, None, 0)
        managed = _ManagedTensor(tensor, None, _delete)
        _LENT[ctypes.addressof(managed)] = managed, shape, self.array
        return _new_capsule(ctypes.addressof(managed), _NAME, _destroy)

    def to_host(self, index: int | None = None) -> np.ndarray:
        """A copy of the array, or of its item `index`, in the memory of the processor; waits for the device."""
        array = self.array if index is None else self.array[index]
        return np.array(array) if isinstance(array, np.ndarray) else array.copy_to_host()


def _number_of_device() -> int:
    from numba import cuda

    return int(cuda.get_current_device().id)
