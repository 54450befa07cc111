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

__all__ = ["csg", "measure", "segment", "smooth", "smooth_csg"]

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


def smooth(buffer: Buffer, *, method: str, width: int, iterations: int, voxel_size: float) -> Buffer:
    """OpenVDB's LevelSetFilter for level sets, its Filter for other grids."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.smooth(first, method, int(width), int(iterations), float(voxel_size)))


def segment(buffer: Buffer, *, voxel_size: float, memory_limit: int) -> list[Buffer]:
    """Connected components, largest first: of a level set's inside, of other grids' active voxels."""
    first = _aligned(buffer)
    return list(_run(lambda bridge: bridge.segment(first, float(voxel_size), float(memory_limit))))


def measure(buffer: Buffer, voxel_size: float) -> tuple[float, float]:
    """Area and enclosed volume of a level set on cubic voxels, in the unit of ``voxel_size``."""
    first = _aligned(buffer)
    area, volume = _run(lambda bridge: bridge.measure(first, float(voxel_size)))
    return float(area) * voxel_size**2, float(volume) * voxel_size**3
