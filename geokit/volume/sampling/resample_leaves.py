"""Resampling of leaves under another transform: which leaves the result may need, and their values."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.memory import available_memory
from geokit.core.memory.row_products import row_product
from geokit.errors import InputError
from geokit.volume.nanovdb.layout import LEAF_VOXELS

# Leaves that are sampled at a time: a quarter of a million points, 13 MB with their values.
LEAVES_AT_A_TIME = 512
# Voxel indices are int32; the margin leaves room for stencils at both ends.
LARGEST_INDEX = 2**31 - 64
REMEDY = "use larger voxels or a nearer origin"


def way_between(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix (3, 3) and shift (3,) that map indices under ``source`` to indices under ``target``.

    Each number is exact up to one rounding, so half a voxel stays exactly half a voxel.

    Raises:
        InputError: A number exceeds float64.
    """
    to, of = ([[Fraction(n) for n in row] for row in matrix[:3].tolist()] for matrix in (target, source))
    # Gauss-Jordan elimination in fractions: the target's axes, then the right-hand sides, which are the source's axes
    # and the vector between the origins.
    rows = [t[:3] + o[:3] + [o[3] - t[3]] for t, o in zip(to, of, strict=True)]
    for k in range(3):
        pivot = next(row for row in rows[k:] if row[k])
        rows.remove(pivot)
        pivot = [n / pivot[k] for n in pivot]
        rows = [[n - row[k] * p for n, p in zip(row, pivot, strict=True)] for row in rows]
        rows.insert(k, pivot)
    try:
        way = np.array([[float(n) for n in row[3:]] for row in rows])
    except OverflowError:
        raise InputError(f"transform: its voxels are not comparable with those of the volume; {REMEDY}") from None
    return way[:, :3], way[:, 3]


def target_leaves(
    origins: NDArray[np.int32], source: NDArray[np.float64], target: NDArray[np.float64], bytes_per_leaf: int
) -> NDArray[np.int32]:
    """First voxels (N, 3) of the result's leaves that may overlap a leaf of the source.

    A leaf counts if the source voxel nearest to one of its voxels may lie in a leaf of the source.

    Args:
        origins: First voxels of the source's leaves, (L, 3).
        source: Transform of the source.
        target: Transform of the result.
        bytes_per_leaf: Memory per leaf while the result is built.
    Raises:
        InputError: Indices of the result exceed int32.
        DeviceMemoryError: The leaves take more memory than there is.
    """
    if not len(origins):
        return np.empty((0, 3), np.int32)
    linear, shift = way_between(source, target)
    center = row_product(origins + 3.5, linear.T, shift)
    # Half the extent of a leaf, with half a voxel around its voxel centers and a margin for rounding.
    reach = 4.0 * np.abs(linear).sum(axis=1) * (1.0 + 1e-9) + 1e-6
    lowest, highest = np.floor((center - reach) / 8.0), np.floor((center + reach) / 8.0)
    if max(-lowest.min(), highest.max()) * 8.0 > LARGEST_INDEX:
        raise InputError(f"transform: voxel indices of the result exceed int32; {REMEDY}")
    size = highest - lowest + 1.0
    # In floats, because tiny voxels give more leaves than int64 can count.
    available_memory.require_room(
        float(size.prod(axis=1).sum()) * bytes_per_leaf,
        "voxel_size: the result may need",
        lambda times: f"use voxels about {times ** (1.0 / 3.0):.2g} times as large",
    )
    size = size.astype(np.int64)
    count = size.prod(axis=1)
    row = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    _, high, deep = size[row].T
    tile = lowest[row].astype(np.int64) + np.stack([step // (high * deep), step // deep % high, step % deep], axis=1)
    return (np.unique(tile, axis=0) * 8).astype(np.int32)


def filled_leaves(
    origins: NDArray[np.int32],
    kind: np.dtype[Any],
    read: Callable[[NDArray[np.int64]], tuple[NDArray[Any], NDArray[np.bool_]]],
) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[Any]]:
    """Origins, masks (L, 64) and values (L, 512) or (L, 512, C) of the leaves that have an active voxel.

    Args:
        origins: First voxels of leaves.
        kind: Type of a value, with its shape for vectors.
        read: Returns values (N,) or (N, C) and active states (N,) of voxels (N, 3).
    """
    origins = origins.copy()
    values = np.empty((len(origins), LEAF_VOXELS), kind)
    masks = np.empty((len(origins), LEAF_VOXELS // 8), np.uint8)
    offsets = np.stack(np.unravel_index(np.arange(LEAF_VOXELS), (8, 8, 8)), axis=1)
    # The next leaves overwrite those without an active voxel. Pages that are never touched take no memory.
    filled = 0
    for first in range(0, len(origins), LEAVES_AT_A_TIME):
        rows = slice(first, first + LEAVES_AT_A_TIME)
        found, states = read((origins[rows, None, :].astype(np.int64) + offsets).reshape(-1, 3))
        active = states.reshape(-1, LEAF_VOXELS)
        used = active.any(axis=1)
        place = slice(filled, filled := filled + int(used.sum()))
        origins[place] = origins[rows][used]
        values[place] = found.reshape(-1, *values.shape[1:])[used]
        masks[place] = np.packbits(active[used], axis=1, bitorder="little")
    return origins[:filled], masks[:filled], values[:filled]
