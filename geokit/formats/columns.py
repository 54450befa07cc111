"""Named columns, as most point files have them, and their conversion to points, rays and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, InputError
from geokit.formats.text_files.words import as_number

__all__ = ["AXES", "Columns", "by_place", "first_rays", "integer_colors", "joined", "split"]

AXES = ("x", "y", "z")
# Names of the components of normals in other programs.
NORMALS = ("nx", "ny", "nz")
# Names of the components of colors in other programs.
COLORS = ("red", "green", "blue")
# As PDAL and CloudCompare name them.
_SPELLED = {name: (name, name.capitalize(), name[0], name[0].upper()) for name in COLORS}
# Interpolated colors leave their range by rounding.
ROUNDED = 1e-6
RAY_COLUMNS = ("ox", "oy", "oz", "dx", "dy", "dz")

Columns = dict[str, NDArray[np.generic]]


def by_place(table: NDArray[np.float64], path: Path) -> Columns:
    """The columns of a table without names: x, y and z, then ``column_3``, ``column_4``, ...

    Args:
        table: Rows of numbers.
        path: The file, for messages.
    Raises:
        FileFormatError: There are fewer than three columns.
    """
    if table.size == 0:
        table = table.reshape(0, 3)
    if table.shape[1] < 3:
        raise FileFormatError(f"{path}: has {table.shape[1]} columns; points need x, y and z")
    names = [*AXES, *(f"column_{at}" for at in range(3, table.shape[1]))]
    return {name: table[:, at] for at, name in enumerate(names)}


def joined(columns: Columns, path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Coordinates, and the other columns with the components of vectors joined into arrays.

    Raises:
        FileFormatError: There are no columns for the coordinates.
    """
    if not set(AXES) <= columns.keys():
        # As PDAL names them.
        columns = {name.lower() if name in ("X", "Y", "Z") else name: values for name, values in columns.items()}
    if not set(AXES) <= columns.keys():
        raise FileFormatError(f"{path}: has no x, y and z; its columns are {in_one_line(', '.join(columns))}")
    points = np.stack([columns.pop(axis).astype(np.float64) for axis in AXES], axis=1)
    data: Columns = {}
    for name in list(columns):
        vector, parts = _vector(name)
        whole = name == parts[0] and vector not in columns and set(parts) <= columns.keys()
        # Components of different types do not form a color.
        if whole and vector not in data and (vector != "rgb" or len({columns[part].dtype for part in parts}) == 1):
            data[vector] = np.stack([columns.pop(part) for part in parts], axis=1)
        elif name in columns:
            data[name] = columns.pop(name)
    return points, data


def _vector(name: str) -> tuple[str, tuple[str, ...]]:
    """The array of which the column ``name`` may be the first component, and the names of its three columns."""
    if name == "nx":
        return "normals", NORMALS
    if name in _SPELLED["red"]:
        at = _SPELLED["red"].index(name)
        return "rgb", tuple(_SPELLED[color][at] for color in COLORS)
    vector = name[:-2]
    return vector, tuple(f"{vector}_{axis}" for axis in AXES) if vector else ("",)


def first_rays(table: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Origins and directions (N, 6): the first six columns of a table without names.

    Raises:
        FileFormatError: There are fewer than six columns.
    """
    if table.size == 0:
        return np.empty((0, 6))
    if table.shape[1] < 6:
        raise FileFormatError(f"{path}: has {table.shape[1]} columns; rays need {', '.join(RAY_COLUMNS)}")
    return table[:, :6]


def split(points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]], kind: str) -> Columns:
    """One column for each number of a point, with names that the format can hold.

    Raises:
        InputError: A name is repeated, contains a character that separates columns, or is a number in .csv.
    """
    columns: Columns = dict(zip(AXES, points.T, strict=True))
    for name, array in data.items():
        if array.ndim == 1:
            parts: tuple[str, ...] = (name,)
        elif array.shape[1] == 3:
            vectors = {"normals": NORMALS, "rgb": COLORS}
            parts = vectors.get(name, tuple(f"{name}_{axis}" for axis in AXES))
        else:
            parts = tuple(f"{name}_{at}" for at in range(array.shape[1]))
        for part, column in zip(parts, array.reshape(len(array), len(parts)).T, strict=True):
            # Readers of .csv take a line with a number in it for a row, not for names.
            unread = not part or not part.isascii() or (kind == ".csv" and as_number(part) is not None)
            if part in columns or unread or any(sign in part for sign in ' ,;"#\t\r\n'):
                raise InputError(f"data: {part!r} is taken or cannot be a column's name in {kind}; rename {name!r}")
            columns[part] = column
    return columns


def integer_colors(values: NDArray[Any], kind: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Colors as integers of a type, full in one as in the other; what is no color stays as it is.

    Floats go from 0 to 1, as Open3D has them, integers of 8 and 16 bits to their largest number. Where none of 16 bits
    is above 255, as in the .las files of many programs, they are taken for bytes, with a warning.
    """
    full = float(np.iinfo(kind).max)
    if values.dtype.kind == "f" and np.all((values >= -ROUNDED) & (values <= 1.0 + ROUNDED)):
        return np.rint(np.clip(values, 0.0, 1.0) * full).astype(kind)
    if values.dtype not in (np.uint8, np.uint16) or values.dtype == kind:
        return values
    given = np.iinfo(values.dtype).max
    if given > full and 0 < values.max(initial=0) <= full:
        warn("colors of 16 bits, none of which is above 255, are taken for bytes")
        return values.astype(kind)
    return np.rint(values * (full / given)).astype(kind)
