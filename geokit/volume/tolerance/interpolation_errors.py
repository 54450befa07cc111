"""Errors of the interpolants of exact voxels at any voxel size, without building a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.types import FIXED_BITS
from geokit.volume.tolerance.zone import Zone

# First voxel of an order's stencil along an axis, relative to the voxel below the point, and number of voxels.
STENCILS = {1: (0, 2), 2: (-1, 3), 3: (-1, 4)}
# Distance [voxels] from a point to the farthest voxel of its stencil.
REACH = {1: 3.0**0.5, 2: 2.0 * 3.0**0.5, 3: 2.0 * 3.0**0.5}
# Numbers are marked in a table of up to so many times their count; sorting them takes longer.
TABLE = 8


class Stencils(NamedTuple):
    """Unique voxels around points.

    Attributes:
        values: Exact distances at the voxels (V,), rounded to float32 as in a grid.
        noise: Quantization error of each voxel, in halves of a step, -1 to 1.
        rows: Voxel of each place of each point's stencil, (N, 4, 4, 4), or (N, 2, 2, 2) for order 1 only.
        first: Place of the voxel below the point within those rows.
        fraction: Position of the point between that voxel and the next, (N, 3).
        exact: The field at the points (N,).
    """

    values: NDArray[np.float64]
    noise: NDArray[np.float64]
    rows: NDArray[np.int64]
    first: int
    fraction: NDArray[np.float64]
    exact: NDArray[np.float64]


def stencils_of(
    zone: Zone, points: NDArray[np.float64], exact: NDArray[np.float64], voxel_size: float, highest_order: int
) -> Stencils:
    """Exact distances at all voxels that the interpolants at points use, for a grid with a voxel at 0.

    Args:
        zone: The zone and its exact field.
        points: Points of the interpolants [world], shape (N, 3).
        exact: The field there [world], shape (N,).
        voxel_size: Edge length of a voxel [world].
        highest_order: 1, 2 or 3; lower orders use a part of its voxels.
    """
    begin, width = STENCILS[1] if highest_order == 1 else STENCILS[3]
    index = points / voxel_size
    below = np.floor(index)
    lowest = below.min(axis=0) + begin
    corner = (below + begin - lowest).astype(np.int64)
    extent = corner.max(axis=0) + width
    strides = np.array([extent[1] * extent[2], extent[2], 1])
    keys = (corner @ strides)[:, None, None, None] + np.tensordot(strides, np.indices((width,) * 3), 1)
    kept, rows = _unique(keys, math.prod(extent.tolist()))
    places = np.stack([kept // (extent[1] * extent[2]), kept // extent[2] % extent[1], kept % extent[2]], axis=1)
    values = zone.truth((places + lowest) * voxel_size).astype(np.float32).astype(np.float64)
    noise = np.random.default_rng(len(values)).uniform(-1.0, 1.0, len(values))
    return Stencils(values, noise, rows, -begin, index - below, exact)


def _unique(numbers: NDArray[np.int64], limit: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers below ``limit`` that occur, in order, and the place of each number among them."""
    if limit > TABLE * numbers.size:
        kept, rows = np.unique(numbers, return_inverse=True)
        return kept, rows.reshape(numbers.shape)
    occurs = np.zeros(limit, bool)
    occurs[numbers] = True
    return np.flatnonzero(occurs), (np.cumsum(occurs) - 1)[numbers]


def interpolation_errors(stencils: Stencils, order: int, limit: float, step: float = 0.0) -> NDArray[np.float64]:
    """Errors of the interpolant of an order at the points, shape (N,).

    Args:
        stencils: Voxels around the points.
        order: 1, 2 or 3.
        limit: Width of the band [world]; values beyond it are cut off.
        step: Distance [world] between adjacent codes of a quantized grid; 0 for floats.
    """
    begin, width = STENCILS[order]
    values = np.clip(stencils.values + stencils.noise * (0.5 * step), -limit, limit)
    axis = slice(stencils.first + begin, stencils.first + begin + width)
    corners = values[stencils.rows[:, axis, axis, axis]]
    for k in (2, 1, 0):
        corners = np.einsum("n...i,ni->n...", corners, axis_weights(order, stencils.fraction[:, k]))
    return np.abs(corners - stencils.exact)


def quantization_step(codec: str, half_width: float, voxel_size: float) -> float:
    """Largest distance [world] between adjacent codes in a leaf of a codec of fixed width; 0 for floats."""
    return 2.0 * half_width * voxel_size / (2.0 ** FIXED_BITS[codec] - 1.0) if codec in FIXED_BITS else 0.0


def axis_weights(order: int, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of a stencil's voxels along an axis, as in ``sample``; shape (N, width)."""
    if order == 1:
        return np.stack([1.0 - t, t], axis=1)
    if order == 2:
        return np.stack([0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)], axis=1)
    u = 1.0 - t
    return np.stack(
        [-0.5 * t * u * u, u * (1.0 + t - 1.5 * t * t), t * (1.0 + u - 1.5 * u * u), -0.5 * u * t * t], axis=1
    )
