"""Launches, prefix sums and memory checks that all isosurface methods share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import available_memory
from geokit.core.memory.device_arena import Scratch, ScratchArray
from geokit.core.memory.pinned import host_arrays
from geokit.errors import DeviceMemoryError

# Planes of 64 cells in a block.
PLANES = 8
# Vertices and faces are numbered by int32.
LARGEST = 2**31 - 1
# Up to this many planes cannot exceed it: a plane has at most 320 faces (64 cells of 5).
SAFE_PLANES = LARGEST // 320
# Slices of a launch per thread; few, because a slice costs 60 us and the work of these kernels is even.
SLICES = 3
# Fewest blocks per slice.
GRAIN = 32
# Needs up to this many bytes are not checked: the query of free memory takes as long as two kernels of a small surface.
UNCHECKED_BYTES = 1 << 24


def launch_planes(kernel: Any, planes: int, inputs: list[Any], outputs: list[Any], device: "wp.Device") -> None:
    """Launch a kernel whose items are planes, eight to a block."""
    span = 1 if device.is_cuda else PLANES
    launch_even(kernel, planes // span, [span, *inputs], outputs, device, least=GRAIN)


def launch_even(
    kernel: Any, count: int, inputs: list[Any], outputs: list[Any], device: "wp.Device", least: int = 512
) -> None:
    grain = max(least, -(-count // (SLICES * launcher.thread_count()))) if device.is_cpu else 0
    launcher.launch(kernel, count, inputs, outputs, device, grain=grain)


def fill_offsets(counts: Sequence[ScratchArray], starts: Sequence[ScratchArray]) -> list[int]:
    """Fill ``starts`` with the prefix sums of ``counts``, for one or two kinds of results.

    Args:
        counts: For each kind, the number of results of each item, int32; equal lengths, on one device.
        starts: For each kind, the output, int32, of the same length.
    Returns:
        Total number of results of each kind.
    Raises:
        DeviceMemoryError: A total exceeds int32.
    """
    from geokit.volume.isosurface.cells_kernels import totals_kernel

    device, items = counts[0].device, len(counts[0])
    (totals,) = host_arrays(device, ((len(counts),), np.int32))
    totals.values.fill(0)
    for some, start in zip(counts, starts, strict=True):
        if items > SAFE_PLANES and int(some.numpy().sum(dtype=np.int64)) > LARGEST:
            raise DeviceMemoryError(
                f"volume: its surface has more than {LARGEST} vertices or faces; resample it to larger voxels"
            )
        wp.utils.array_scan(some.warp, start.warp, inclusive=False)
    inputs = [counts[0], starts[0], counts[-1], starts[-1]]
    launcher.launch(totals_kernel, len(counts) if items else 0, inputs, [totals], device)
    found: list[int] = totals.numpy().tolist()
    return found


def used_only(vertices: "wp.array", faces: "wp.array") -> tuple["wp.array", "wp.array"]:
    """Remove the vertices that no face uses: those of edges between inactive voxels.

    Args:
        vertices: (V,) of vec3d.
        faces: Vertex numbers, (3 F,) of int32.
    Raises:
        DeviceMemoryError: There is not enough memory.
    """
    from geokit.core.sorting.gather_kernels import GATHER
    from geokit.volume.isosurface import cells_kernels as kernels

    device = vertices.device
    require_memory(32 * len(vertices) + 4 * len(faces), device)
    used, place = Scratch(device, *[((len(vertices),), wp.int32)] * 2, zeroed=True).arrays
    launch_even(kernels.mark_used_kernel, len(faces), [faces], [used], device)
    (count,) = fill_offsets([used], [place])
    if count == len(vertices):
        return vertices, faces
    kept = wp.empty(count, dtype=wp.vec3d, device=device)
    launch_even(kernels.keep_used_kernel, len(vertices), [vertices, used, place], [kept], device)
    renumbered = wp.empty(len(faces), dtype=wp.int32, device=device)
    launch_even(GATHER[wp.int32], len(faces), [place, faces], [renumbered], device)
    return kept, renumbered


def require_memory(need: int, device: Any) -> None:
    for place in (device, None) if need > UNCHECKED_BYTES else ():
        what = "volume: finding its surface needs"
        available_memory.require_room(need, what, "resample it to larger voxels", place)
