"""Launches, offsets and memory of the steps that make a mesh of an isosurface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch, _memory
from geokit._pinned import host_arrays
from geokit._scratch import Scratch, ScratchArray
from geokit.errors import DeviceMemoryError

if TYPE_CHECKING:
    import warp as wp

__all__ = ["GRAIN", "PLANES", "launch_even", "launch_planes", "offsets_of", "require_memory", "used_only"]

# Planes of 64 cells in a block.
PLANES = 8
# Vertices and faces are numbered by int32.
LARGEST = 2**31 - 1
# So many planes have fewer: a plane has at most 320 faces (64 cells of 5).
SAFE_PLANES = LARGEST // 320
# Slices of a launch per thread: a slice costs 60 us, and the work of these kernels is spread evenly.
SLICES = 3
# Fewest blocks worth a slice.
GRAIN = 32
# So much there is, or nothing else would run: to ask takes as long as two kernels of a small surface.
UNASKED_BYTES = 1 << 24


def launch_planes(kernel: Any, planes: int, inputs: list[Any], outputs: list[Any], device: "wp.Device") -> None:
    """Launch a kernel whose items are planes, of eight to a block."""
    span = 1 if device.is_cuda else PLANES
    launch_even(kernel, planes // span, [span, *inputs], outputs, device, least=GRAIN)


def launch_even(
    kernel: Any, count: int, inputs: list[Any], outputs: list[Any], device: "wp.Device", least: int = 512
) -> None:
    grain = max(least, -(-count // (SLICES * _launch.thread_count()))) if device.is_cpu else 0
    _launch.launch(kernel, count, inputs, outputs, device, grain=grain)


def offsets_of(*counts: Any) -> tuple[list[ScratchArray], list[int]]:
    """Where each item's results start, and how many there are in all, of one kind of results or of several.

    Args:
        counts: ScratchArrays of int32, of one device.
    Raises:
        DeviceMemoryError: More than int32 can number.
    """
    import warp as wp

    from geokit.volume._isosurface_cells_kernels import total_kernel

    device = counts[0].device
    starts = Scratch(device, *(((len(some),), wp.int32) for some in counts)).arrays
    (totals,) = host_arrays(device, ((len(counts),), np.int32))
    totals.values.fill(0)
    for number, (some, start) in enumerate(zip(counts, starts, strict=True)):
        if len(some) > SAFE_PLANES and int(some.numpy().sum(dtype=np.int64)) > LARGEST:
            raise DeviceMemoryError(
                f"volume: its surface has more than {LARGEST} vertices or faces; resample it to larger voxels"
            )
        if len(some):
            wp.utils.array_scan(some.warp, start.warp, inclusive=False)
            _launch.launch(total_kernel, 1, [number, some, start], [totals], device)
    return starts, totals.numpy().tolist()


def used_only(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Without the vertices that no face uses: those of edges between voxels that are not active."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    if used.all():
        return vertices, faces
    number = np.cumsum(used, dtype=np.int32) - 1
    return vertices[used], number[faces]


def require_memory(need: int, device: Any) -> None:
    if need <= UNASKED_BYTES:
        return
    have = min(_memory.available(device), _memory.available_host())
    if need > have:
        raise DeviceMemoryError(
            f"volume: finding its surface needs about {need >> 20} MiB of the {have >> 20} MiB free on "
            f"{device.alias}; resample it to larger voxels"
        )
