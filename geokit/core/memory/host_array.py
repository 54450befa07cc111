"""NumPy arrays as arguments of CPU kernels, without the cost of a warp array."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.launches import prepared, warp_private
from geokit.core.launches.warp_private import KernelArray


class HostArray(KernelArray):
    """Contiguous NumPy rows that a CPU kernel reads or writes: (N,) numbers, or (N, 3) where it takes vec3d.

    Creating and freeing a warp array takes as long as a query of one point; this takes a fifth of that. It is an
    argument for :func:`geokit.core.launcher.launch`; other code uses :attr:`warp`.
    """

    __slots__ = ("_descriptor", "_warp", "values")

    def __init__(self, values: np.ndarray) -> None:
        self.values = values
        self._descriptor: Any = None
        self._warp: Any = None

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: slice) -> HostArray:
        return HostArray(self.values[rows])

    def numpy(self) -> np.ndarray:
        if recording := prepared.current():
            recording.read(self.values)
        return self.values

    def is_raised(self, place: int) -> bool:
        """Whether there is something to do, of which a flag tells."""
        return bool(self.numpy()[place])

    @property
    def device(self) -> "wp.Device":
        return wp.get_device("cpu")

    @property
    def descriptor(self) -> Any:
        if self._descriptor is None:
            data = self.values.__array_interface__["data"][0]
            self._descriptor = array_descriptor(data, self.values.shape[:1], self.values.strides[0])
        return self._descriptor

    @property
    def warp(self) -> "wp.array":
        """A warp array over the same memory."""
        if self._warp is None:
            values = self.values
            vector = wp.vec3f if values.dtype == np.float32 else wp.vec3d
            dtype = vector if values.ndim == 2 else wp.dtype_from_numpy(values.dtype)
            self._warp = wp.array(
                ptr=values.ctypes.data,
                dtype=dtype,
                shape=(len(values),),
                device="cpu",
                capacity=values.nbytes,
                copy=False,
            )
            self._warp._geokit_source = values  # the array does not own the memory it points to
        return self._warp


def array_descriptor(data: int, shape: tuple[int, ...], size: int) -> Any:
    """Warp's descriptor of a contiguous array at address ``data`` with elements of ``size`` bytes."""
    descriptor = warp_private.descriptor_type()()
    descriptor.data = data
    descriptor.ndim = len(shape)
    for axis in range(len(shape) - 1, -1, -1):
        descriptor.shape[axis] = shape[axis]
        descriptor.strides[axis] = size
        size *= shape[axis]
    return descriptor


@functools.lru_cache(maxsize=64)
def row_of(dtype: Any) -> np.ndarray:
    """An empty NumPy array with the dtype and row shape of a warp type: (0,) numbers, or (0, 3) for vectors."""
    none: np.ndarray = wp.empty(0, dtype=dtype, device="cpu").numpy()
    return none
