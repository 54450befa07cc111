"""Smoothing of level sets and of other scalar volumes."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.level_set.operands import require_level_set
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.openvdb_call import call_openvdb

__all__ = ["smooth"]

LEVEL_SET_METHODS = ("gaussian", "mean", "median", "mean_curvature", "laplacian")
FIELD_METHODS = ("gaussian", "mean", "median")
# OpenVDB copies leaves and this many voxels around them.
WIDEST = 64
MOST_ITERATIONS = 10_000


def smooth(volume: SparseVolume, method: str = "gaussian", *, width: int = 1, iterations: int = 1) -> SparseVolume:
    """A smoother volume.

    Level sets move: "gaussian" (four box filters), "mean" and "median" over a cube, "mean_curvature" and "laplacian"
    by one step of the flow; after each iteration the band follows the surface and its values are brought back towards
    distances. Other volumes are filtered at their active voxels, with the background counting outside. Nothing is
    promised about the volume inside: convex bodies shrink.

    One gaussian pass of width 1 moves the surface inwards by 2.7 voxel^2 over the radius of curvature, to 0.05 voxel
    from a radius of 8 voxels on; balls of 2 voxels and less disappear. Held by
    tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: Float or double grid; quantised ones become float.
        method: "gaussian", "mean" or "median"; for level sets also "mean_curvature" or "laplacian".
        width: Half the filter's side [voxels], 1 to 64; the two flows have none and ignore it.
        iterations: How often.
    Returns:
        Volume of the same class and background.
    Raises:
        InputError: An unknown method, or one for level sets on another grid; width or iterations out of range; a level
            set whose voxels are no cubes.
        UnsupportedGridError: Values that are not real numbers.
        MissingDependencyError: geokit was built without OpenVDB.
    Source:
        OpenVDB's LevelSetFilter and Filter.
    """
    require_volume(volume, "volume", ("float", "double"))
    is_level_set = volume.info.grid_class == "level set"
    known = LEVEL_SET_METHODS if is_level_set else FIELD_METHODS
    if method not in known:
        kind = "a level set" if is_level_set else f"a grid of class {volume.info.grid_class}"
        raise InputError(f"method: {method!r} does not smooth {kind}; use one of {', '.join(known)}")
    width = _checked_count(width, "width", WIDEST)
    iterations = _checked_count(iterations, "iterations", MOST_ITERATIONS)
    voxel_size = require_level_set(volume, "volume") if is_level_set else 1.0
    from geokit.native import operations

    result: SparseVolume = call_openvdb(
        operations.smooth, volume, method=method, width=width, iterations=iterations, voxel_size=voxel_size
    )
    return result


def _checked_count(value: Any, name: str, largest: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= largest:
        raise InputError(f"{name}: {value!r} is not usable; give a whole number from 1 to {largest}")
    return int(value)
