"""Scratch arrays for a few launches, all in one allocation.

Creating and freeing a warp array takes as long as a small launch, on either device.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from geokit.core.base.late_warp import wp
from geokit.core.launches.warp_private import KernelArray
from geokit.core.memory.host_array import array_descriptor

if TYPE_CHECKING:
    import numpy as np

ALIGNMENT = 64


class Scratch:
    """One allocation that holds several arrays; it lives as long as any of them.

    Args:
        device: The device of the memory.
        shapes: Shape, (N,) or (N, M), and warp type of each array.
        zeroed: Fill the arrays with zeros; otherwise they are uninitialized.
    """

    __slots__ = ("arrays", "device", "memory")

    def __init__(self, device: "wp.Device", *shapes: tuple[tuple[int, ...], Any], zeroed: bool = False) -> None:
        sizes = [math.prod(shape) * wp.types.type_size_in_bytes(dtype) for shape, dtype in shapes]
        starts, total = [], 0
        for size in sizes:
            starts.append(total)
            total += -(-size // ALIGNMENT) * ALIGNMENT
        self.device = device
        # Warp counts elements in 31 bits, so a large arena cannot be an array of bytes.
        self.memory = (wp.zeros if zeroed else wp.empty)(total // 8, dtype=wp.uint64, device=device)
        begin = self.memory.ptr or 0
        self.arrays = [
            ScratchArray(self, begin + start, shape, dtype)
            for start, (shape, dtype) in zip(starts, shapes, strict=True)
        ]


class ScratchArray(KernelArray):
    """An array of a :class:`Scratch`, for :func:`geokit.core.launcher.launch`; other code uses :attr:`warp`."""

    __slots__ = ("_descriptor", "_scratch", "_warp", "dtype", "ptr", "shape")

    def __init__(self, scratch: Scratch, ptr: int, shape: tuple[int, ...], dtype: Any) -> None:
        self._scratch, self.ptr, self.shape, self.dtype = scratch, ptr, shape, dtype
        self._descriptor: Any = None
        self._warp: Any = None

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def device(self) -> "wp.Device":
        return self._scratch.device

    @property
    def descriptor(self) -> Any:
        if self._descriptor is None:
            self._descriptor = array_descriptor(self.ptr, self.shape, wp.types.type_size_in_bytes(self.dtype))
        return self._descriptor

    @property
    def warp(self) -> "wp.array":
        """A warp array over the same memory, which it keeps alive."""
        if self._warp is None:
            self._warp = wp.array(ptr=self.ptr, dtype=self.dtype, shape=self.shape, device=self.device)
            self._warp._geokit_source = self._scratch.memory
        return self._warp

    def numpy(self) -> np.ndarray:
        values: np.ndarray = self.warp.numpy()
        return values
