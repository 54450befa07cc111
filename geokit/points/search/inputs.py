"""Validation of the arguments of neighbor searches, before anything is built."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError

__all__ = ["require_order", "require_radii", "require_radius", "require_self"]


def require_radius(radius: Any) -> float:
    value = require_finite_scalar(radius, "radius")
    if value < 0.0:
        raise InputError(f"radius: {value:g} is negative; give 0 or more")
    return value


def require_radii(radius: Any, count: int) -> np.ndarray:
    try:
        values = np.asarray(radius.numpy() if hasattr(radius, "numpy") else radius, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"radius: cannot be read as numbers ({error})") from error
    if values.shape != (count,):
        raise InputError(f"radius: shape {values.shape} is not one number, nor one for each of the {count} queries")
    bad = ~(np.isfinite(values) & (values >= 0.0))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"radius: row {row} is {values[row]:g}; give finite numbers that are 0 or more")
    return values


def require_order(order: str) -> None:
    if order not in ("index", "distance", "any"):
        raise InputError(f"order: {order!r} is not known; give 'index', 'distance' or 'any'")


def require_self(exclude_self: bool, query_count: int, point_count: int) -> None:
    if exclude_self and query_count != point_count:
        raise InputError(
            f"exclude_self: {query_count} queries are not the {point_count} points; leave queries out, or exclude_self"
        )
