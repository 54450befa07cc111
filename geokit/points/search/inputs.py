"""Validation of the arguments of neighbor searches, before anything is built."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core.interop.user_arrays import read_numbers, require_finite_scalar
from geokit.core.require import require_choice, require_flag
from geokit.errors import InputError

__all__ = ["require_order", "require_radii", "require_radius", "require_self", "require_skin"]


def require_radius(radius: Any) -> float:
    value = require_finite_scalar(radius, "radius")
    if value < 0.0:
        raise InputError(f"radius: {value:g} is negative; give 0 or more")
    return value


def require_skin(skin: Any, radius: float | None) -> float:
    value = require_finite_scalar(skin, "skin", low=0.0)
    if not np.isfinite(value + (radius or 0.0)):
        raise InputError(f"skin: {value:g} and the radius are more than a float64 can hold; scale the points down")
    return value


def require_radii(radius: Any, count: int) -> float | np.ndarray:
    values = read_numbers(radius, "radius")
    if values.ndim == 0:
        return require_radius(values)
    if values.shape != (count,):
        raise InputError(f"radius: shape {values.shape} is not one number, nor one for each of the {count} queries")
    bad = ~(np.isfinite(values) & (values >= 0.0))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"radius: row {row} is {values[row]:g}; give finite numbers that are 0 or more")
    return values


def require_order(order: str) -> None:
    require_choice(order, "order", ("index", "distance", "any"))


def require_self(exclude_self: bool, query_count: int, point_count: int) -> None:
    if require_flag(exclude_self, "exclude_self") and query_count != point_count:
        raise InputError(
            f"exclude_self: {query_count} queries are not the {point_count} points; leave queries out, or exclude_self"
        )
