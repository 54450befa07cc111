"""Conversion of dense arrays to trees of any value type: choice of the type, and the leaves and tiles.

Floats have their own kernels (``volume/tree/dense_tiles.py``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.launcher import pool
from geokit.core.memory import available_memory
from geokit.core.require import described, read_array
from geokit.errors import InputError
from geokit.volume.nanovdb.layout import LAYOUTS, LEAF_VOXELS, GridLayout
from geokit.volume.nanovdb.types import CLASS_TYPES, WHOLE_TYPES, WHOLE_VECTOR_TYPES
from geokit.volume.tree.typed_tree import VALUE_TYPES, Nodes, TypedTree, tree_of_leaves

# Numbers that a thread processes together: with their states they stay in its cache.
NUMBERS_AT_A_TIME = 1 << 18
# States of a tile.
LEAF, INSIDE = 1, 2


@dataclass(frozen=True)
class DenseRule:
    """Which values count as background: those within a tolerance in each component, in a level set with either sign.

    Attributes:
        layout: Layout of the grid's type.
        background: Background value, () or (C,), of that type.
        tolerance: Largest difference that counts as background.
        level_set: Whether minus the background counts too.
    """

    layout: GridLayout
    background: NDArray[Any]
    tolerance: float
    level_set: bool

    def active(self, block: NDArray[Any]) -> NDArray[np.bool_]:
        """Mask of the voxels (A, B, C) or (A, B, C, D) that are not background."""
        level = np.abs(block) if self.level_set else block
        if self.tolerance == 0.0:
            unlike = level != self.background
        elif level.dtype.kind == "f":
            with np.errstate(over="ignore"):
                unlike = np.abs(level.astype(np.float64) - self.background.astype(np.float64)) > self.tolerance
        else:
            unlike = self._beyond(level)
        return np.asarray(unlike.any(axis=-1) if self.background.ndim else unlike)

    def _beyond(self, level: NDArray[Any]) -> NDArray[np.bool_]:
        # Limits are compared, since the type may not hold a difference, nor float64 all of the type's numbers.
        kind = np.dtype(np.uint8) if level.dtype == np.bool_ else level.dtype
        ends, reach = np.iinfo(kind), math.floor(self.tolerance)
        middle = self.background.astype(kind)
        low, high = (
            np.array([min(max(int(n) + step, ends.min), ends.max) for n in middle.flat], kind).reshape(middle.shape)
            for step in (-reach, reach)
        )
        numbers = level.view(kind)
        return np.asarray((numbers < low) | (numbers > high))

    def rest(self, values: NDArray[Any], active: NDArray[np.bool_]) -> None:
        """Set inactive voxels (N, 512) or (N, 512, C) to the background, in place."""
        if self.level_set:
            np.copyto(values, np.where(values < 0, -self.background, self.background), where=~active)
        else:
            values[~active] = self.background


def require_leaves(count: int, each: int) -> None:
    """Raise DeviceMemoryError if the host has no room for ``count`` leaves of an array, of ``each`` bytes."""
    remedy = "use a larger tolerance, or parts of the array"
    available_memory.require_room(count * each, f"values: {count} leaves need", remedy)


def tree_of_dense(dense: NDArray[Any], start: NDArray[np.int64], rule: DenseRule) -> TypedTree:
    """Build the tree of an array: leaves where a voxel is active, and in a level set tiles inside.

    Args:
        dense: Shape (X, Y, Z) or (X, Y, Z, C), real numbers.
        start: Index of its first voxel, shape (3,).
        rule: Defines the background, which is not stored.
    Raises:
        InputError: The type cannot hold a value.
        DeviceMemoryError: The leaves do not fit into memory.
    """
    tiles, layout, background = _Tiles(dense, start, rule), rule.layout, rule.background
    # NumPy releases the GIL in most of these passes.
    states = np.concatenate([np.zeros((0, *tiles.count[1:]), np.uint8), *pool().map(tiles.states, tiles.layers)])
    places = np.argwhere(states == LEAF)
    require_leaves(len(places), LEAF_VOXELS * layout.background.itemsize + layout.leaf_size + 256)
    values = np.empty((len(places), LEAF_VOXELS, *background.shape), background.dtype)
    masks = np.empty((len(places), LEAF_VOXELS // 8), np.uint8)
    pool().map(lambda x: tiles.fill(x, places, values, masks), tiles.layers)
    tree = tree_of_leaves(layout, background, tiles.origins_of(places), masks, values)
    inside = tiles.origins_of(np.argwhere(states == INSIDE))
    # Unsigned numbers and bits have no negative.
    value = -background if len(inside) else background
    return replace(tree, lower=Nodes.of_tiles(inside, value, False, background, 16, 8))


class _Tiles:
    """The tiles of 8^3 voxels that an array touches, processed a few layers along x at a time."""

    def __init__(self, dense: NDArray[Any], start: NDArray[np.int64], rule: DenseRule) -> None:
        self.dense, self.rule = dense, rule
        # Position of the array in its first tile, and the number of tiles.
        self.shift = start & 7
        self.first = start - self.shift
        self.count = -(-(self.shift + dense.shape[:3]) // 8) if dense.size else np.zeros(3, np.int64)
        plane = max(1, dense.size // max(1, len(dense)))
        self.step = max(1, NUMBERS_AT_A_TIME // (8 * plane))
        # The first layer of each part.
        self.layers = range(0, int(self.count[0]), self.step)

    def origins_of(self, places: NDArray[np.int64]) -> NDArray[np.int32]:
        """First voxels of tiles, (N, 3)."""
        return np.asarray((self.first + 8 * places).astype(np.int32))

    def states(self, x: int) -> NDArray[np.uint8]:
        """State of the tiles of a part, (A, B, C): LEAF, INSIDE or 0.

        Raises:
            InputError: The type cannot hold a value.
        """
        block = self._block(x, checked=True)
        state = (_any(self.rule.active(block)) * LEAF).astype(np.uint8)
        if self.rule.level_set:
            negative = block < 0
            rests = state == 0
            # A block with both signs cannot be a tile, so it is a leaf, even without active voxels.
            state[rests & _any(negative)] = LEAF
            state[rests & ~_any(~negative)] = INSIDE
        return state

    def fill(self, x: int, places: NDArray[np.int64], values: NDArray[Any], masks: NDArray[np.uint8]) -> None:
        """Write values and masks of the leaves of a part into their rows."""
        rows = slice(*np.searchsorted(places[:, 0], [x, x + self.step]))
        if rows.start == rows.stop:
            return
        block = self._block(x)
        at = places[rows] - np.array([x, 0, 0])
        active = _tiled(self.rule.active(block))[tuple(at.T)].reshape(-1, LEAF_VOXELS)
        values[rows] = _tiled(block)[tuple(at.T)].reshape(values[rows].shape)
        self.rule.rest(values[rows], active)
        masks[rows] = np.packbits(active, axis=1, bitorder="little")

    def _block(self, x: int, *, checked: bool = False) -> NDArray[Any]:
        """The voxels of a part's tiles as the grid stores them, padded with background around the array."""
        background = self.rule.background
        low = max(0, 8 * x - int(self.shift[0]))
        part = self.dense[low : 8 * (x + self.step) - int(self.shift[0])]
        begin = [low + int(self.shift[0]) - 8 * x, *map(int, self.shift[1:])]
        layers = -(-(begin[0] + len(part)) // 8)
        shape = (8 * layers, *(8 * self.count[1:]), *background.shape)
        if part.shape == shape and part.dtype == background.dtype:
            stored = block = part
        else:
            block = np.empty(shape, background.dtype)
            block[:] = background
            stored = block[tuple(slice(a, a + n) for a, n in zip(begin, part.shape, strict=False))]
            with np.errstate(all="ignore"):
                np.copyto(stored, part, casting="unsafe")
        if checked and (bad := _cannot_hold(stored, part)).any():
            i, j, k, *_ = np.argwhere(bad)[0]
            raise InputError(
                f"values: voxel [{low + i}, {j}, {k}] is {part[i, j, k]}, which {self.rule.layout.name} cannot hold; "
                "replace such voxels, or name another grid_type"
            )
        return block


def _tiled(block: NDArray[Any]) -> NDArray[Any]:
    """Rearrange a block (8 A, 8 B, 8 C, ...) by tiles, (A, B, C, 8, 8, 8, ...)."""
    a, b, c = (n // 8 for n in block.shape[:3])
    return np.moveaxis(block.reshape(a, 8, b, 8, c, 8, *block.shape[3:]), (2, 4), (1, 2))


def _any(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of the tiles (A, B, C) of a block that have a true voxel."""
    # Eight voxels are read as one word: twenty times as fast as any().
    a, b, c = (n // 8 for n in voxels.shape)
    words = np.ascontiguousarray(voxels).view(np.uint64).reshape(a, 8, b, 8, c)
    return np.asarray(np.bitwise_or.reduce(np.bitwise_or.reduce(words, axis=3), axis=1) != 0)


def layout_for(values: NDArray[Any], grid_type: str | None, grid_class: str) -> GridLayout:
    """Choose the layout of an array's grid.

    Args:
        values: Shape (X, Y, Z) or (X, Y, Z, C), real numbers.
        grid_type: Requested type, or None for the array's own.
        grid_class: Class of the grid.
    Raises:
        InputError: The type does not exist, cannot hold such an array, or does not allow the class.
    """
    name = _own_type(values, grid_class) if grid_type is None else grid_type
    if name not in VALUE_TYPES:
        remedy = "make a float grid and quantize() it" if name in LAYOUTS else f"use one of {', '.join(VALUE_TYPES)}"
        raise InputError(f"grid_type: {name!r} is none that arrays are made of; {remedy}")
    layout = LAYOUTS[name]
    if values.shape[3:] != layout.background.shape:
        wanted = ", ".join(["X", "Y", "Z", *map(str, layout.background.shape)])
        raise InputError(f"values: shape {values.shape} is not ({wanted}); give what voxels of type {name} hold")
    # Float grids accept every class, for compatibility.
    if name != "float" and name not in CLASS_TYPES.get(grid_class, (name,)):
        raise InputError(
            f"grid_class: no {grid_class} is of type {name}; use 'unknown'"
            + (f", or grid_type={CLASS_TYPES[grid_class][0]!r}" if CLASS_TYPES[grid_class] else "")
        )
    return layout


def _own_type(values: NDArray[Any], grid_class: str) -> str:
    count = 1 if values.ndim == 3 else values.shape[3]
    if values.ndim == 4 and count not in (3, 4):
        raise InputError(f"values: shape {values.shape} has {count} components; give (X, Y, Z), or 3 or 4 of them")
    if values.dtype.kind == "f" or (count == 1 and "float" in CLASS_TYPES.get(grid_class, ())):
        return "float" if count == 1 else f"vec{count}f"
    kind = values.dtype.str[1:]
    found = WHOLE_TYPES.get(kind) if count == 1 else WHOLE_VECTOR_TYPES.get((kind, count))
    if found is None:
        remedy = "'int64' or 'float'" if count == 1 else f"'vec{count}f' or 'vec{count}d'"
        raise InputError(f"values: no grid has {count} {values.dtype} in a voxel; name a grid_type, {remedy}")
    return found


def background_of(value: Any, layout: GridLayout) -> NDArray[Any]:
    """A background as a grid stores it, () or (C,); a single number applies to all components.

    Raises:
        InputError: The type cannot hold it.
    """
    kind = layout.background
    remedy = f"give {'a number' if not kind.shape else f'one number, or {kind.shape[0]},'} that {layout.name} holds"
    given = read_array(value, "background", kinds="fiub")
    if given.dtype.kind not in "fiub" or given.shape not in ((), kind.shape):
        raise InputError(f"background: {described(value)} is no value of type {layout.name}; {remedy}")
    with np.errstate(all="ignore"):
        stored = np.array(np.broadcast_to(given, kind.shape).astype(kind.base))
    if _cannot_hold(stored, given).any():
        raise InputError(f"background: {described(value)} is no value of type {layout.name}; {remedy}")
    if layout.name == "mask" and stored:
        raise InputError("background: what a mask does not store is off; give False, or invert the array")
    return stored


def _cannot_hold(stored: NDArray[Any], given: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the numbers that were lost in ``stored = given.astype(...)``.

    Types of floats hold the nearest value of every number within their range, other types exact numbers only.
    """
    if stored.dtype.kind == "f":
        return np.asarray(~np.isfinite(stored))
    if np.can_cast(given.dtype, stored.dtype, "safe"):
        return np.zeros(stored.shape, np.bool_)
    # A number that wrapped around may convert back to itself, so its sign is compared too.
    with np.errstate(all="ignore"):
        back = stored.astype(given.dtype)
    return np.asarray((back != given) | ((stored < 0) != (given < 0)))
