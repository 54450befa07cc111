"""OpenVDB's operations on volumes: NanoVDB buffers in, NanoVDB buffers out.

Thin: arguments are checked by ``geokit.volume``. Every function raises ``MissingDependencyError`` where the extension
is not there, ``UnsupportedGridError`` for a grid type that the operation does not have, and ``InputError`` for a buffer
that is no NanoVDB grid. Quantised grids become float grids. Name, class and transform are those of the first buffer.
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
    """ "union", "intersection" or "difference" of level sets on one lattice with equal backgrounds."""
    first, second = _aligned(a), _aligned(b)
    return _run(lambda bridge: bridge.csg(first, second, kind))


def smooth_csg(a: Buffer, b: Buffer, kind: str, blend: float) -> Buffer:
    """The same with a smooth minimum; both bands must reach ``blend`` [values] beyond their surface."""
    first, second = _aligned(a), _aligned(b)
    return _run(lambda bridge: bridge.smooth_csg(first, second, kind, float(blend)))


def redistance(
    buffer: Buffer, *, voxel_size: float, half_width: float, isovalue: float = 0.0, keeps_band: bool = False
) -> Buffer:
    """Signed distances from the surface at ``isovalue`` [voxels], in a band of ``half_width`` [voxels].

    Args:
        buffer: Level set on cubic voxels.
        voxel_size: Edge of a voxel in the unit of the values.
        half_width: Of the new band [voxels].
        isovalue: Value of the surface [voxels]; 0 with ``keeps_band``.
        keeps_band: Active voxels keep their values; only voxels beyond them are computed.
    """
    first = _aligned(buffer)
    return _run(
        lambda bridge: bridge.redistance(first, float(voxel_size), float(half_width), float(isovalue), bool(keeps_band))
    )


def smooth(buffer: Buffer, *, method: str, width: int, iterations: int, voxel_size: float) -> Buffer:
    """OpenVDB's LevelSetFilter for level sets, its Filter for other grids."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.smooth(first, method, int(width), int(iterations), float(voxel_size)))


def prune(buffer: Buffer, tolerance: float) -> Buffer:
    """Nodes whose values differ by at most ``tolerance`` and share their state become tiles."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.prune(first, float(tolerance)))


def clip(buffer: Buffer, bounds: NDArray[np.float64]) -> Buffer:
    """Voxels whose centres are outside the box (2, 3) [world] become inactive background."""
    first = _aligned(buffer)
    lower, upper = bounds.tolist()
    return _run(lambda bridge: bridge.clip(first, lower, upper))


def segment(buffer: Buffer, *, voxel_size: float, memory_limit: int) -> list[Buffer]:
    """Connected components, largest first: of a level set's inside, of other grids' active voxels."""
    first = _aligned(buffer)
    return list(_run(lambda bridge: bridge.segment(first, float(voxel_size), float(memory_limit))))


def voxelized(buffer: Buffer) -> Buffer:
    """The same grid with leaves in place of active tiles, and floats in place of quantised values."""
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
    """A grid from its leaves; a level set's empty regions get their signs.

    Args:
        origins: First voxel of each leaf, multiples of 8, shape (L, 3), each once.
        values: float32 or float64, shape (L, 512) or (L, 512, 3), z fastest.
        masks: Active voxels, shape (L, 64), bit z of byte ``8 x + y``.
        background: A number, or three.
        transform: Index to world, shape (4, 4).
        name: Of the grid.
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
