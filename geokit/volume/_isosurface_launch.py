"""Launches, offsets and memory of the steps that make a mesh of an isosurface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch, _memory
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


def launch_planes(kernel: Any, planes: int, inputs: list[Any], outputs: list[Any], device: "wp.Device") -> None:
    """Launch a kernel whose items are planes, of eight to a block."""
    span = 1 if device.is_cuda else PLANES
    launch_even(kernel, planes // span, [span, *inputs], outputs, device, least=GRAIN)


def launch_even(
    kernel: Any, count: int, inputs: list[Any], outputs: list[Any], device: "wp.Device", least: int = 512
) -> None:
    grain = max(least, -(-count // (SLICES * _launch.thread_count())))
    _launch.launch(kernel, count, inputs, outputs, device, grain=grain)


def offsets_of(counts: "wp.array") -> tuple["wp.array", int]:
    """Where each item's results start, and how many there are.

    Raises:
        DeviceMemoryError: More than int32 can number.
    """
    import warp as wp

    start = wp.empty(len(counts), dtype=wp.int32, device=counts.device)
    if not len(counts):
        return start, 0
    if len(counts) > SAFE_PLANES and int(counts.numpy().sum(dtype=np.int64)) > LARGEST:
        raise DeviceMemoryError(
            f"volume: its surface has more than {LARGEST} vertices or faces; resample it to larger voxels"
        )
    wp.utils.array_scan(counts, start, inclusive=False)
    return start, int(start[-1:].numpy()[0]) + int(counts[-1:].numpy()[0])


def used_only(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Without the vertices that no face uses: those of edges between voxels that are not active."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    if used.all():
        return vertices, faces
    number = np.cumsum(used, dtype=np.int32) - 1
    return vertices[used], number[faces]


def require_memory(need: int, device: Any) -> None:
    have = min(_memory.available(device), _memory.available_host())
    if need > have:
        raise DeviceMemoryError(
            f"volume: finding its surface needs about {need >> 20} MiB of the {have >> 20} MiB free on "
            f"{device.alias}; resample it to larger voxels"
        )
