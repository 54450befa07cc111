"""Bounding boxes and extrema of the active values of leaves, tiles and nodes, for grids of any value type.

Grids of bits have no extrema in NanoVDB.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.volume.nanovdb.layout import GridLayout
from geokit.volume.nanovdb.nodes import bits_of

# The neutral element of a union of boxes.
NO_BOX = np.array([[[np.iinfo(np.int32).max] * 3, [np.iinfo(np.int32).min] * 3]], np.int32)
_BITS = np.array([bin(i).count("1") for i in range(256)], np.uint8)
_FIRST_BIT = np.array([8] + [(i & -i).bit_length() - 1 for i in range(1, 256)], np.int8)
_LAST_BIT = np.array([i.bit_length() - 1 for i in range(256)], np.int8)


class Items(NamedTuple):
    """Boxes and extrema of the active voxels of some leaves, tiles or nodes.

    Attributes:
        boxes: First and last active voxel, (N, 2, 3) int32, in reverse order if there is none.
        low: Smallest active value, (N,) or (N, C); for vectors the shortest.
        high: Largest active value; for vectors the longest.
        low_key: Sort key of ``low``: the value itself, or the square of its length.
        high_key: Sort key of ``high``.
    """

    boxes: NDArray[np.int32]
    low: NDArray[Any]
    high: NDArray[Any]
    low_key: NDArray[Any]
    high_key: NDArray[Any]

    @classmethod
    def empty(cls, kind: np.dtype[Any], count: int) -> Items:
        """Allocate items of values of a type, with its shape for vectors, that hold no active voxel."""
        values = [np.zeros((count, *kind.shape), kind.base) for _ in range(2)]
        keys = [np.zeros(count, np.float64) for _ in range(2)] if kind.shape else values
        return cls(np.repeat(NO_BOX, count, axis=0), *values, *keys)

    def some(self, part: slice = slice(None)) -> NDArray[np.bool_]:
        """Mask of the items that have an active voxel."""
        return self.boxes[part, 0, 0] <= self.boxes[part, 1, 0]


def items_of_leaves(
    layout: GridLayout,
    origins: NDArray[np.int32],
    masks: NDArray[np.uint8],
    values: NDArray[Any],
    out: Items,
    part: slice,
) -> NDArray[np.int64]:
    """Fill a part of ``out`` from leaves; returns their numbers of active voxels."""
    local = _local_boxes(masks)
    some = local[:, 0, 0] <= local[:, 1, 0]
    out.boxes[part] = np.where(some[:, None, None], local + origins[:, None, :], NO_BOX)
    if layout.leaf_bits > 1:
        active = bits_of(masks)
        keys = _keys(layout, values)
        rows = np.arange(len(values))
        for column, key_column, best, worst in (
            (out.low, out.low_key, np.argmin, _largest(keys.dtype)),
            (out.high, out.high_key, np.argmax, _least(keys.dtype)),
        ):
            at = best(np.where(active, keys, worst), axis=1)
            # If all active values equal the worst possible value, an inactive one may have been found.
            at = np.where(active[rows, at], at, np.argmax(active, axis=1))
            column[part] = values[rows, at]
            if key_column is not column:
                key_column[part] = keys[rows, at]
    return np.asarray(_BITS[masks].sum(axis=1, dtype=np.int64))


def items_of_tiles(layout: GridLayout, origins: NDArray[np.int32], values: NDArray[Any], span: int) -> Items:
    """Items of active tiles of ``span``^3 voxels."""
    boxes = np.stack([origins, origins + np.int32(span - 1)], axis=1)
    if layout.leaf_bits <= 1:
        values = np.zeros_like(values)
    keys = _keys(layout, values)
    return Items(boxes, values, values, keys, keys)


def add_items(
    items: Items, parent: NDArray[np.int64], more: Items, more_parent: NDArray[np.int64]
) -> tuple[Items, NDArray[np.int64]]:
    """Concatenate two sets of items, with the nodes that contain them."""
    if not len(more_parent):
        return items, parent
    return Items(*map(np.concatenate, zip(items, more, strict=True))), np.concatenate([parent, more_parent])


def reduced(items: Items, parent: NDArray[np.int64], count: int) -> Items:
    """Reduce items to those of the ``count`` nodes that contain them."""
    out = Items.empty(np.dtype((items.low.dtype, items.low.shape[1:])), count)
    used = np.flatnonzero(items.some())
    if not len(used):
        return out
    parent = parent[used]
    rows = used[np.lexsort((items.low_key[used], parent))]
    most = used[np.lexsort((_turned(items.high_key[used]), parent))]
    nodes, counts = np.unique(parent, return_counts=True)
    starts = np.cumsum(counts) - counts
    out.boxes[nodes, 0] = np.minimum.reduceat(items.boxes[rows, 0], starts)
    out.boxes[nodes, 1] = np.maximum.reduceat(items.boxes[rows, 1], starts)
    out.low[nodes], out.high[nodes] = items.low[rows[starts]], items.high[most[starts]]
    if out.low_key is not out.low:
        out.low_key[nodes], out.high_key[nodes] = items.low_key[rows[starts]], items.high_key[most[starts]]
    return out


def _local_boxes(packed: NDArray[np.uint8]) -> NDArray[np.int32]:
    """First and last active voxel of leaves, in local coordinates, shape (L, 2, 3); first > last if none is active."""
    planes = packed.view("<u8")
    columns = np.bitwise_or.reduce(planes, axis=1, keepdims=True).view(np.uint8)
    rows = np.bitwise_or.reduce(columns, axis=1, keepdims=True)
    used = np.concatenate(
        [
            np.packbits(planes != 0, axis=1, bitorder="little"),
            np.packbits(columns != 0, axis=1, bitorder="little"),
            rows,
        ],
        axis=1,
    )
    return np.stack([_FIRST_BIT[used], _LAST_BIT[used]], axis=1).astype(np.int32)


def _keys(layout: GridLayout, values: NDArray[Any]) -> NDArray[Any]:
    if not layout.background.shape:
        return values
    with np.errstate(over="ignore", invalid="ignore"):
        return np.square(values.astype(np.float64)).sum(axis=-1)


def _turned(keys: NDArray[Any]) -> NDArray[Any]:
    """Keys that sort numbers in descending order."""
    return ~keys if keys.dtype.kind in "iub" else -keys


def _largest(dtype: np.dtype[Any]) -> Any:
    return True if dtype.kind == "b" else np.inf if dtype.kind == "f" else np.iinfo(dtype).max


def _least(dtype: np.dtype[Any]) -> Any:
    return False if dtype.kind == "b" else -np.inf if dtype.kind == "f" else np.iinfo(dtype).min
