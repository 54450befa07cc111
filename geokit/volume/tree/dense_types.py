"""Which grid type an array of voxels becomes, and numbers as that type holds them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError
from geokit.volume.nanovdb.layout import LAYOUTS, GridLayout
from geokit.volume.nanovdb.types import CLASS_TYPES, WHOLE_TYPES, WHOLE_VECTOR_TYPES
from geokit.volume.tree.typed_tree import VALUE_TYPES

__all__ = ["background_of", "cannot_hold", "layout_for"]


def layout_for(values: NDArray[Any], grid_type: str | None, grid_class: str) -> GridLayout:
    """Layout of the grid that an array becomes.

    Args:
        values: Shape (X, Y, Z) or (X, Y, Z, C), real numbers.
        grid_type: The type that was asked for, or None for the array's own.
        grid_class: Of the grid.
    Raises:
        InputError: There is no such type, it is none for such an array, or has no such class.
    """
    name = _own_type(values, grid_class) if grid_type is None else grid_type
    if name not in VALUE_TYPES:
        remedy = "make a float grid and quantize() it" if name in LAYOUTS else f"use one of {', '.join(VALUE_TYPES)}"
        raise InputError(f"grid_type: {name!r} is none that arrays are made of; {remedy}")
    layout = LAYOUTS[name]
    if values.shape[3:] != layout.background.shape:
        wanted = ", ".join(["X", "Y", "Z", *map(str, layout.background.shape)])
        raise InputError(f"values: shape {values.shape} is not ({wanted}); give what voxels of type {name} hold")
    # Float grids have always taken every class.
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
    """A background as a grid stores it, () or (C,); one number serves for all components.

    Raises:
        InputError: It is none that the type holds.
    """
    kind = layout.background
    remedy = f"give {'a number' if not kind.shape else f'one number, or {kind.shape[0]},'} that {layout.name} holds"
    try:
        given = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"background: {error}; {remedy}") from None
    if given.dtype.kind not in "fiub" or given.shape not in ((), kind.shape):
        raise InputError(f"background: {value!r} is no value of type {layout.name}; {remedy}")
    with np.errstate(all="ignore"):
        stored = np.array(np.broadcast_to(given, kind.shape).astype(kind.base))
    if cannot_hold(stored, given).any():
        raise InputError(f"background: {value!r} is no value of type {layout.name}; {remedy}")
    if layout.name == "mask" and stored:
        raise InputError("background: what a mask does not store is off; give False, or invert the array")
    return stored


def cannot_hold(stored: NDArray[Any], given: NDArray[Any]) -> NDArray[np.bool_]:
    """Where numbers were lost in ``stored = given.astype(...)``.

    Types of floats hold the nearest of all numbers within their range, others exact ones.
    """
    if stored.dtype.kind == "f":
        return np.asarray(~np.isfinite(stored))
    if np.can_cast(given.dtype, stored.dtype, "safe"):
        return np.zeros(stored.shape, np.bool_)
    # A number that wrapped around may come back as it was, on the other side of zero.
    with np.errstate(all="ignore"):
        back = stored.astype(given.dtype)
    return np.asarray((back != given) | ((stored < 0) != (given < 0)))
