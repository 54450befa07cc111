"""Numbers in and out of the text formats (.obj, .off, ASCII .stl and .ply)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

__all__ = ["numbers", "point_lines", "polygons"]


def numbers(tokens: list[bytes], dtype: type, path: Path, what: str) -> NDArray[Any]:
    """Tokens as an array of ``dtype``, each rounded correctly.

    Raises:
        FileFormatError: A token is not a number of this type; the message names the token and its place.
    """
    if not tokens:
        return np.zeros(0, dtype)
    try:
        return np.array(tokens, dtype=dtype)
    except (ValueError, OverflowError):
        pass
    convert = int if np.issubdtype(dtype, np.integer) else float
    for at, token in enumerate(tokens):
        try:
            np.array(convert(token), dtype=dtype)
        except (ValueError, OverflowError):
            shown = token[:40].decode("ascii", "backslashreplace")
            raise FileFormatError(
                f"{path}: '{shown}' (number {at} of the {what}) is not a number that fits; the file is damaged"
            ) from None
    raise FileFormatError(f"{path}: the {what} cannot be read as numbers; the file is damaged")


def polygons(tokens: list[bytes], count: int, path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """``count`` runs of ``n i1 .. in`` from the start of ``tokens``: corner counts, indices, and tokens used.

    Raises:
        FileFormatError: The tokens end early or are not integers.
    """
    uniform = _uniform_polygons(tokens, count, path)
    if uniform is not None:
        return uniform
    counts = np.empty(count, np.int64)
    corners: list[bytes] = []
    at = 0
    for row in range(count):
        size = int(numbers(tokens[at : at + 1], np.int64, path, "face sizes")[0]) if at < len(tokens) else -1
        if size < 0 or at + 1 + size > len(tokens):
            raise FileFormatError(
                f"{path}: the file ends in face {row} of the {count} it declares; it is truncated, get a whole copy"
            )
        counts[row] = size
        corners += tokens[at + 1 : at + 1 + size]
        at += 1 + size
    return counts, numbers(corners, np.int64, path, "face indices"), at


def _uniform_polygons(tokens: list[bytes], count: int, path: Path) -> tuple[Any, Any, int] | None:
    # Nearly every file has one polygon size: read as one table, thirty times faster than polygon by polygon.
    if count == 0 or not tokens or not tokens[0].isdigit():
        return None
    size = int(tokens[0])
    used = count * (size + 1)
    if used > len(tokens) or any(token != tokens[0] for token in tokens[0 : used : size + 1]):
        return None
    table = numbers(tokens[:used], np.int64, path, "faces").reshape(count, size + 1)
    return table[:, 0], table[:, 1:].ravel(), used


def point_lines(points: NDArray[np.float64], prefix: str = "") -> Iterable[str]:
    """Lines of three numbers with the fewest digits that read back as the same float64."""
    return (f"{prefix}{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
