"""OpenVDB's operations on volumes, as functions from NanoVDB buffers to NanoVDB buffers.

A thin layer: ``geokit.volume`` checks the arguments. Every function raises ``MissingDependencyError`` without the
extension, ``UnsupportedGridError`` for a grid type that the operation does not support, and ``InputError`` for a buffer
that is not a NanoVDB grid. Quantized grids become float grids. Name, class and transform come from the first buffer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from geokit.native import _aligned, _call, _extension

__all__ = [
    "clip",
    "csg",
    "from_leaves",
    "measure",
    "prune",
    "redistance",
    "segment",
    "smooth",
    "smooth_csg",
    "voxelized",
]

Buffer = NDArray[np.uint8]
_Result = TypeVar("_Result")


def _run(function: Callable[[Any], _Result]) -> _Result:
    extension = _extension()
    return _call("volume", lambda: function(extension), is_argument=True)


def csg(a: Buffer, b: Buffer, kind: str) -> Buffer:
    """Combine two level sets on one lattice with equal backgrounds: "union", "intersection" or "difference"."""
    first, second = _aligned(a), _aligned(b)
    return _run(lambda bridge: bridge.csg(first, second, kind))


def smooth_csg(a: Buffer, b: Buffer, kind: str, blend: float) -> Buffer:
    """As :func:`csg`, with a smooth minimum; both bands must reach ``blend`` [value units] beyond their surface."""
    first, second = _aligned(a), _aligned(b)
    return _run(lambda bridge: bridge.smooth_csg(first, second, kind, float(blend)))


def redistance(
    buffer: Buffer, *, voxel_size: float, half_width: float, isovalue: float = 0.0, keeps_band: bool = False
) -> Buffer:
    """Recompute signed distances from the surface at ``isovalue`` [voxels], in a band of ``half_width`` [voxels].

    Args:
        buffer: Level set on cubic voxels.
        voxel_size: Edge length of a voxel in the unit of the values.
        half_width: Half width of the new band [voxels].
        isovalue: Value of the surface [voxels]; 0 with ``keeps_band``.
        keeps_band: Keep the values of active voxels and compute only the voxels beyond them.
    """
    first = _aligned(buffer)
    return _run(
        lambda bridge: bridge.redistance(first, float(voxel_size), float(half_width), float(isovalue), bool(keeps_band))
    )


def smooth(buffer: Buffer, *, method: str, width: int, iterations: int, voxel_size: float) -> Buffer:
    """Smooth with OpenVDB's LevelSetFilter (level sets) or Filter (other grids)."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.smooth(first, method, int(width), int(iterations), float(voxel_size)))


def prune(buffer: Buffer, tolerance: float) -> Buffer:
    """Replace nodes by tiles if their values differ by at most ``tolerance`` and their states are equal."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.prune(first, float(tolerance)))


def clip(buffer: Buffer, bounds: NDArray[np.float64]) -> Buffer:
    """Make voxels inactive background if their centers are outside the box ``bounds`` (2, 3) [world]."""
    first = _aligned(buffer)
    lower, upper = bounds.tolist()
    return _run(lambda bridge: bridge.clip(first, lower, upper))


def segment(buffer: Buffer, *, voxel_size: float, memory_limit: int) -> list[Buffer]:
    """Connected components of a level set's inside, or of another grid's active voxels, largest first."""
    first = _aligned(buffer)
    return list(_run(lambda bridge: bridge.segment(first, float(voxel_size), float(memory_limit))))


def voxelized(buffer: Buffer) -> Buffer:
    """Replace active tiles by leaves, and quantized values by floats."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.voxelized(first))


def measure(buffer: Buffer, voxel_size: float) -> tuple[float, float]:
    """Area and enclosed volume of a level set on cubic voxels, in the unit of ``voxel_size``."""
    first = _aligned(buffer)
    area, volume = _run(lambda bridge: bridge.measure(first, float(voxel_size)))
    return float(area) * voxel_size**2, float(volume) * voxel_size**3


def from_leaves(
    origins: NDArray[np.int32],
    values: NDArray[Any],
    masks: NDArray[np.uint8],
    *,
    background: Any,
    transform: NDArray[np.float64],
    name: str,
    grid_class: str,
) -> Buffer:
    """Build a grid from its leaves; for a level set, also set the signs of empty regions.

    Args:
        origins: First voxel of each leaf, multiples of 8, distinct, shape (L, 3).
        values: float32 or float64, shape (L, 512) or (L, 512, 3), z fastest.
        masks: Active voxels, shape (L, 64), bit z of byte ``8 x + y``.
        background: The background value, one number or three.
        transform: Index to world, shape (4, 4).
        name: Name of the grid.
        grid_class: "level set", "fog volume", "staggered" or "unknown".
    """
    is_double = values.dtype == np.float64
    components = 1 if values.ndim == 2 else 3
    rows = np.ascontiguousarray(origins, np.int32).reshape(-1, 3)
    raw = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
    packed = np.ascontiguousarray(masks).reshape(-1)
    outside = np.zeros(3)
    outside[:components] = background
    matrix = np.asarray(transform, np.float64)[:3].ravel().tolist()
    return _run(
        lambda bridge: bridge.from_leaves(
            rows, raw, packed, components, is_double, outside.tolist(), name, grid_class, matrix
        )
    )
