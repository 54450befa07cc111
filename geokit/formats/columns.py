"""Columns by name, as most point files have them, and the points and arrays that they make up."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError, InputError

__all__ = ["joined", "read_columns", "read_table", "split"]

AXES = ("x", "y", "z")
# What other programs call the components of normals.
NORMALS = ("nx", "ny", "nz")
# And those of colours.
COLORS = ("red", "green", "blue")

Columns = dict[str, NDArray[np.generic]]


def read_columns(path: Path, kind: str) -> Columns:
    """Columns by name, in the order of the file.

    Raises:
        FileFormatError: The content is damaged or has no columns for the coordinates.
    """
    if kind == ".pcd":
        from geokit.formats.pcd import read_pcd

        return read_pcd(path)
    if kind == ".pts":
        from geokit.formats.pts import read_pts

        return read_pts(path)
    if kind == ".ply":
        from geokit.formats.ply_points import read_ply

        return read_ply(path)
    if kind == ".obj":
        return dict(zip(AXES, _obj_vertices(path).T, strict=True))
    names, table = read_table(path, kind)
    if table.size == 0:
        table = table.reshape(0, max(len(names), 3))
    if len(set(names)) != len(names):
        raise FileFormatError(f"{path}: two columns are called '{_repeated(names)}'; give each its own name")
    lowered = [name.lower() for name in names]
    if not set(AXES) <= set(lowered):
        if table.shape[1] < 3:
            raise FileFormatError(f"{path}: has {table.shape[1]} columns; points need x, y and z")
        # Names of other things than coordinates: the first three columns are the coordinates.
        names = [*AXES, *(names[3:] or [f"column_{at}" for at in range(3, table.shape[1])])]
    else:
        names = [low if low in AXES else name for name, low in zip(names, lowered, strict=True)]
    return {name: table[:, at] for at, name in enumerate(names)}


def read_table(path: Path, kind: str) -> tuple[list[str], NDArray[np.float64]]:
    """The names of the columns, if the file has them, and the rows of numbers."""
    if kind == ".npy":
        from geokit.formats.numpy_files import read_array

        return [], read_array(path)
    from geokit.formats.text_tables import read_text

    return read_text(path)


def _obj_vertices(path: Path) -> NDArray[np.float64]:
    rows = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        words = line.split()
        if not words or words[0] != b"v":
            continue
        try:
            x, y, z = map(float, words[1:4])
        except ValueError:
            shown = line[:60].decode("ascii", "backslashreplace")
            raise FileFormatError(f"{path}: line {number} ('{shown}') is not a vertex; the file is damaged") from None
        rows.append((x, y, z))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def joined(columns: Columns, path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Coordinates, and the other columns with the components of vectors put together."""
    if not set(AXES) <= columns.keys():
        raise FileFormatError(f"{path}: has no x, y and z; its columns are {', '.join(columns)}")
    points = np.stack([columns.pop(axis).astype(np.float64) for axis in AXES], axis=1)
    data: Columns = {}
    for name in list(columns):
        vector, parts = _vector(name)
        whole = name == parts[0] and vector not in columns and set(parts) <= columns.keys()
        # Colours of several types are not colours.
        if whole and (vector != "rgb" or len({columns[part].dtype for part in parts}) == 1):
            data[vector] = np.stack([columns.pop(part) for part in parts], axis=1)
        elif name in columns:
            data[name] = columns.pop(name)
    return points, data


def _vector(name: str) -> tuple[str, tuple[str, ...]]:
    """The array that a column called ``name`` may begin, and what its three columns are called."""
    if name == "nx":
        return "normals", NORMALS
    if name == "red":
        return "rgb", COLORS
    vector = name[:-2]
    return vector, tuple(f"{vector}_{axis}" for axis in AXES) if vector else ("",)


def split(points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]], kind: str) -> Columns:
    """One column for each number of a point, by names that the format can hold."""
    columns: Columns = dict(zip(AXES, points.T, strict=True))
    for name, array in data.items():
        if array.ndim == 1:
            parts: tuple[str, ...] = (name,)
        elif array.shape[1] == 3:
            named = {"normals": NORMALS, "rgb": COLORS}
            parts = named.get(name, tuple(f"{name}_{axis}" for axis in AXES))
        else:
            parts = tuple(f"{name}_{at}" for at in range(array.shape[1]))
        for part, column in zip(parts, array.reshape(len(array), len(parts)).T, strict=True):
            if part in columns or not part.isascii() or any(sign in part for sign in ' ,;"#\t\r\n') or not part:
                raise InputError(f"data: '{part}' is taken or cannot be a column's name in {kind}; rename '{name}'")
            columns[part] = column
    return columns


def _repeated(names: list[str]) -> str:
    return next(name for at, name in enumerate(names) if name in names[:at])
