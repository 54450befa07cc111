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

from geokit.native._openvdb import _aligned, _call, _extension

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


def smooth(buffer: Buffer, *, method: str, width: int, iterations: int, voxel_size: float) -> Buffer:
    """Smooth with OpenVDB's LevelSetFilter (level sets) or Filter (other grids)."""
    first = _aligned(buffer)
    return _run(lambda bridge: bridge.smooth(first, method, int(width), int(iterations), float(voxel_size)))


def measure(buffer: Buffer, voxel_size: float) -> tuple[float, float]:
    """Area and enclosed volume of a level set on cubic voxels, in the unit of ``voxel_size``."""
    first = _aligned(buffer)
    area, volume = _run(lambda bridge: bridge.measure(first, float(voxel_size)))
    # Products become infinite where powers of Python's floats raise OverflowError.
    return float(area) * voxel_size * voxel_size, float(volume) * voxel_size * voxel_size * voxel_size
