"""Argument checks and color maps that all figures share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import require_extension
from geokit.errors import InputError

__all__ = ["DIVERGING", "SEQUENTIAL", "checked_size", "checked_target", "checked_values", "value_range"]

# Perceptually uniform, readable in gray and by most color-blind readers.
SEQUENTIAL = "viridis"
# For signed quantities: white at zero.
DIVERGING = "RdBu_r"

# Smallest and largest side in pixels: below, nothing is readable; above, software renderers refuse the frame buffer.
SMALLEST, LARGEST = 64, 8192


def checked_target(path: str | os.PathLike[str]) -> Path:
    require_extension(path, (".png",), "figure")
    return Path(path)


def checked_size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = (int(side) for side in size)
    except (TypeError, ValueError) as error:
        raise InputError(f"size: {size!r} is not (width, height) in pixels") from error
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise InputError(f"size: {width}x{height} is outside {SMALLEST} to {LARGEST} pixels a side; choose another")
    return width, height


def checked_values(values: Any, name: str, counts: dict[str, int]) -> tuple[str, NDArray[np.float64]]:
    """Match an array of values to the items that it describes, by their number.

    Args:
        values: One number for each item; it need not be finite.
        name: The argument's name for error messages.
        counts: Number of items by kind, such as vertices and faces.
    Returns:
        The kind of item, and the values as float64.
    Raises:
        InputError: The values are not numbers, or no kind in ``counts`` has as many items.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: cannot be read as numbers ({error}); give one value for each item") from error
    if array.ndim == 1:
        for what, count in counts.items():
            if len(array) == count:
                return what, array
    have = ", ".join(f"{count} {what}" for what, count in counts.items())
    raise InputError(f"{name}: shape {array.shape} does not match {have}; give one value for each")


def value_range(
    values: NDArray[np.float64], given: tuple[float, float] | None, *, centred: bool = False
) -> tuple[float, float]:
    """Color limits: the given ones, else the range of the finite values, else (0, 1)."""
    if given is not None:
        low, high = float(given[0]), float(given[1])
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"value_range: {given!r} is not (low, high) with low < high")
        return low, high
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if centred:
        high = max(abs(low), abs(high))
        low = -high
    # A constant field still needs a range of some width.
    return (low, high) if high > low else (low - 0.5, high + 0.5)
