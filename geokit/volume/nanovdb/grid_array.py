"""Grids in the memory of devices, also larger than an array of warp, which counts its items in 31 bits.

Of a larger grid the array shows the first 2^31 - 1 bytes. Kernels take its address, and offsets of 64 bits.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.download import bytes_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_ARRAY = (1 << 31) - 1


def array_of(buffer: NDArray[np.uint8]) -> "wp.array":
    """A grid in host memory as an array that shares it."""
    shown: Any = wp.array(buffer[:LARGEST_ARRAY], dtype=wp.uint8, device="cpu", copy=False)
    shown._geokit_source = buffer
    return shown


def empty_grid(size: int, device: "wp.Device", *, zeroed: bool = True) -> "wp.array":
    """Memory on a device for a grid of ``size`` bytes."""
    # Items of 32 bytes, of which warp counts 2^31.
    items = -(-size // wp.types.type_size_in_bytes(wp.vec4d))
    made: Any = (wp.zeros if zeroed else wp.empty)(items, dtype=wp.vec4d, device=device)
    shown: Any = wp.array(ptr=made.ptr, dtype=wp.uint8, shape=(min(size, LARGEST_ARRAY),), device=device)
    shown._geokit_source = made  # it owns the memory
    return shown


def copied_grid(source: "wp.array", size: int, device: "wp.Device") -> "wp.array":
    """Copy a grid of ``size`` bytes to a device."""
    made = empty_grid(size, device, zeroed=False)
    for start in range(0, size, LARGEST_ARRAY):
        count = min(LARGEST_ARRAY, size - start)
        wp.copy(bytes_of(made, start, count), bytes_of(source, start, count))
    return made


def made_volume(grid: "wp.array", size: int) -> "wp.Volume":
    """A warp.Volume of a grid of ``size`` bytes, which must outlive it.

    Raises:
        RuntimeError: There is another volume of the same memory.
    """
    # Of its argument it uses these three alone.
    memory: Any = SimpleNamespace(device=grid.device, ptr=grid.ptr, size=size)
    return wp.Volume(memory, copy=False)
