"""Point sets and rays in files."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit._files import atomic_path, require_extension, require_file
from geokit.errors import FileFormatError, InputError

__all__ = ["PointCloud", "Rays", "load", "load_rays", "save"]

_READABLE = (".csv", ".npy", ".npz", ".obj", ".ply", ".txt", ".vtp", ".xyz")
_RAY_FORMATS = (".csv", ".npy", ".npz", ".txt", ".xyz")
_WRITABLE = (".csv", ".npz", ".ply", ".vtp", ".xyz")
_AXES = ("x", "y", "z")
_RAY_COLUMNS = ("ox", "oy", "oz", "dx", "dy", "dz")
# What other programs call the components of normals.
_NORMALS = ("nx", "ny", "nz")

Columns = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points and what is known about each, checked when made.

    Args:
        points: Positions [world], shape (N, 3); kept as read-only float64.
        data: Arrays of numbers with N rows, shape (N,) or (N, K), by name; kept in their own types.
    Raises:
        InputError: points is not (N, 3) or not finite, or an array of data is not numbers or has other than N rows.
    """

    points: NDArray[np.float64]
    data: Mapping[str, NDArray[np.generic]]

    def __init__(self, points: ArrayLike, data: Mapping[str, ArrayLike] | None = None) -> None:
        table = _points(points)
        arrays = {name: _data(values, name, len(table)) for name, values in (data or {}).items()}
        object.__setattr__(self, "points", table)
        object.__setattr__(self, "data", MappingProxyType(arrays))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"PointCloud({len(self.points)} points, data: {', '.join(self.data) or 'none'})"


class Rays(NamedTuple):
    """origins (N, 3) [world] and directions (N, 3), float64."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]


def load(path: str | os.PathLike[str]) -> PointCloud:
    """Points from a file, with whatever numbers it has for each.

    Reads .ply (vertices), .vtp (points), .csv, .xyz and .txt (columns named x, y, z, else the first three), .npy
    ((N, K), the first three columns), .npz (the array ``points``, else the only one of shape (N, 3); other arrays with
    N rows are data) and .obj (vertices). Columns ``name_x, name_y, name_z`` become one array (N, 3), ``nx, ny, nz``
    the array ``normals``; unnamed columns are called ``column_3``, ``column_4``, ... Text gives float64 data.

    Args:
        path: The file; its extension says what is in it.
    Returns:
        PointCloud.
    Raises:
        InputError: The extension is none of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged, has no coordinates, or a point that is not finite; the row is named.
    """
    kind = require_extension(path, _READABLE, "point")
    path = require_file(path)
    if kind == ".vtp":
        from geokit.points._vtp import read_vtp

        points, data = read_vtp(path)
    elif kind == ".npz":
        points, data = _from_archive(_archive(path), path)
    else:
        points, data = _from_columns(_columns(path, kind), path)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(f"{path}: point {row} is not finite ({points[row].tolist()}); remove or replace it")
    return PointCloud(points, data)


def load_rays(path: str | os.PathLike[str]) -> Rays:
    """Rays from a file: .csv, .txt, .xyz, .npy with columns ox, oy, oz, dx, dy, dz (else the first six) or .npz.

    An .npz holds the arrays ``origins`` and ``directions``, or one of shape (N, 6). Directions need not have unit
    length.

    Args:
        path: The file; its extension says what is in it.
    Returns:
        Rays(origins, directions), each (N, 3) float64.
    Raises:
        InputError: The extension is none of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged or has no six columns, or a ray is not finite or has no direction; its
            row is named.
    """
    kind = require_extension(path, _RAY_FORMATS, "ray")
    path = require_file(path)
    table = _ray_table(path, kind)
    bad = ~np.isfinite(table).all(axis=1) | ~(table[:, 3:] != 0.0).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(f"{path}: ray {row} has no usable direction or origin ({table[row].tolist()}); remove it")
    return Rays(np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3:]))


def save(path: str | os.PathLike[str], points: ArrayLike, *, data: Mapping[str, ArrayLike] | None = None) -> None:
    """Writes points and arrays that go with them; whoever reads the file meanwhile sees the old one or the new one.

    .vtp, .csv, .npz, .ply (binary) and .xyz all keep float64. In .csv, .ply and .xyz an array (N, 3) becomes the
    columns ``name_x, name_y, name_z`` (``normals``: nx, ny, nz), one of another width ``name_0, name_1, ...``.

    Args:
        path: The file; its extension says what is written.
        points: Positions [world], shape (N, 3).
        data: Arrays of numbers with N rows, shape (N,) or (N, K), by name.
    Raises:
        InputError: The extension is none of these, points or data cannot be used, or a name cannot stand in the format.
        FileAccessError: The folder is missing or the file cannot be written.
    """
    kind = require_extension(path, _WRITABLE, "point")
    cloud = PointCloud(points, data)
    if kind in (".csv", ".ply", ".xyz"):
        columns = _split(cloud, kind)
    elif kind == ".npz" and "points" in cloud.data:
        raise InputError("data: the name 'points' is taken by the positions in .npz; choose another")
    with atomic_path(path) as part:
        if kind == ".vtp":
            from geokit.points._vtp import write_vtp

            write_vtp(part, cloud.points, cloud.data)
        elif kind == ".npz":
            with zipfile.ZipFile(part, "w", allowZip64=True) as archive:
                for name, values in {"points": cloud.points, **cloud.data}.items():
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                        np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)
        elif kind == ".ply":
            from geokit.points._ply import write_ply

            write_ply(part, list(columns), list(columns.values()))
        else:
            from geokit.points._text import write_text

            write_text(part, list(columns), list(columns.values()), comma=kind == ".csv")


def _points(values: ArrayLike) -> NDArray[np.float64]:
    try:
        table = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"points: cannot be read as an (N, 3) table of numbers ({error})") from None
    if table.size == 0:
        table = table.reshape(0, 3)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"points: shape {table.shape} is not (N, 3); give one row of x, y, z for each")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"points: row {row} is not finite ({table[row].tolist()}); remove or replace such rows")
    table.flags.writeable = False
    return table


def _data(values: ArrayLike, name: str, count: int) -> NDArray[np.generic]:
    array = np.array(values)
    if array.dtype.kind not in "fiub":
        raise InputError(f"data: '{name}' has dtype {array.dtype}; give numbers")
    if array.ndim not in (1, 2) or len(array) != count:
        raise InputError(f"data: '{name}' has shape {array.shape}; give one row for each of the {count} points")
    array.flags.writeable = False
    return array


def _columns(path: Path, kind: str) -> Columns:
    """Columns by name, in the order of the file."""
    if kind == ".ply":
        from geokit.points._ply import read_ply

        return read_ply(path)
    if kind == ".obj":
        return dict(zip(_AXES, _obj_vertices(path).T, strict=True))
    names, table = _table(path, kind)
    if table.size == 0:
        table = table.reshape(0, max(len(names), 3))
    if len(set(names)) != len(names):
        raise FileFormatError(f"{path}: two columns are called '{_repeated(names)}'; give each its own name")
    lowered = [name.lower() for name in names]
    if not set(_AXES) <= set(lowered):
        if table.shape[1] < 3:
            raise FileFormatError(f"{path}: has {table.shape[1]} columns; points need x, y and z")
        # Names of other things than coordinates: the first three columns are the coordinates.
        names = [*_AXES, *(names[3:] or [f"column_{at}" for at in range(3, table.shape[1])])]
    else:
        names = [low if low in _AXES else name for name, low in zip(names, lowered, strict=True)]
    return {name: table[:, at] for at, name in enumerate(names)}


def _table(path: Path, kind: str) -> tuple[list[str], NDArray[np.float64]]:
    if kind != ".npy":
        from geokit.points._text import read_text

        return read_text(path)
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise FileFormatError(f"{path}: is not a NumPy array ({error}); write it again with numpy.save") from None
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        shape = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else "an archive"
        raise FileFormatError(f"{path}: holds {shape}; it needs to be a table of numbers, one row for each point")
    return [], array.astype(np.float64)


def _archive(path: Path) -> Columns:
    try:
        # Opened here: numpy leaves a file that is not an archive open.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, TypeError, AttributeError) as error:
        raise FileFormatError(f"{path}: is not a NumPy archive ({error}); write it again with numpy.savez") from None


def _from_archive(arrays: Columns, path: Path) -> tuple[NDArray[np.float64], Columns]:
    tables = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] == 3]
    if "points" not in tables and len(tables) != 1:
        raise FileFormatError(f"{path}: has no array 'points' of shape (N, 3); its arrays are {', '.join(arrays)}")
    name = "points" if "points" in tables else tables[0]
    points = arrays.pop(name)
    if points.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: array '{name}' has dtype {points.dtype}; it needs to be numbers")
    fitting = {
        key: array
        for key, array in arrays.items()
        if array.ndim in (1, 2) and len(array) == len(points) and array.dtype.kind in "fiub"
    }
    return points.astype(np.float64), fitting


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


def _from_columns(columns: Columns, path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Coordinates, and the other columns with the components of vectors put together."""
    if not set(_AXES) <= columns.keys():
        raise FileFormatError(f"{path}: has no x, y and z; its columns are {', '.join(columns)}")
    points = np.stack([columns.pop(axis).astype(np.float64) for axis in _AXES], axis=1)
    data: Columns = {}
    for name in list(columns):
        parts = _NORMALS if name == "nx" else tuple(f"{name[:-2]}_{axis}" for axis in _AXES)
        vector = "normals" if name == "nx" else name[:-2]
        if name == parts[0] and vector and vector not in columns and set(parts) <= columns.keys():
            data[vector] = np.stack([columns.pop(part) for part in parts], axis=1)
        elif name in columns:
            data[name] = columns.pop(name)
    return points, data


def _split(cloud: PointCloud, kind: str) -> Columns:
    """One column for each number of a point, by names that the format can hold."""
    columns: Columns = dict(zip(_AXES, cloud.points.T, strict=True))
    for name, array in cloud.data.items():
        if array.ndim == 1:
            parts: tuple[str, ...] = (name,)
        elif array.shape[1] == 3:
            parts = _NORMALS if name == "normals" else tuple(f"{name}_{axis}" for axis in _AXES)
        else:
            parts = tuple(f"{name}_{at}" for at in range(array.shape[1]))
        for part, column in zip(parts, array.reshape(len(array), len(parts)).T, strict=True):
            if part in columns or not part.isascii() or any(sign in part for sign in ' ,;"#\t\r\n') or not part:
                raise InputError(f"data: '{part}' is taken or cannot be a column's name in {kind}; rename '{name}'")
            columns[part] = column
    return columns


def _ray_table(path: Path, kind: str) -> NDArray[np.float64]:
    if kind == ".npz":
        arrays: dict[str, Any] = _archive(path)
        if {"origins", "directions"} <= arrays.keys():
            parts = [np.asarray(arrays[name]) for name in ("origins", "directions")]
        else:
            wide = [array for array in arrays.values() if array.ndim == 2 and array.shape[1] >= 6]
            parts = [wide[0][:, :3], wide[0][:, 3:6]] if len(wide) == 1 else []
        shapes = {part.shape for part in parts}
        if len(shapes) != 1 or parts[0].ndim != 2 or parts[0].shape[1] != 3:
            raise FileFormatError(f"{path}: has no arrays 'origins' and 'directions' of one shape (N, 3)")
        if any(part.dtype.kind not in "fiu" for part in parts):
            raise FileFormatError(f"{path}: origins or directions are not numbers")
        return np.concatenate(parts, axis=1).astype(np.float64)
    names, table = _table(path, kind)
    lowered = [name.lower() for name in names]
    if table.size == 0:
        return np.empty((0, 6))
    if set(_RAY_COLUMNS) <= set(lowered):
        return table[:, [lowered.index(name) for name in _RAY_COLUMNS]]
    if table.shape[1] < 6:
        raise FileFormatError(f"{path}: has {table.shape[1]} columns; rays need {', '.join(_RAY_COLUMNS)}")
    return table[:, :6]


def _repeated(names: list[str]) -> str:
    return next(name for at, name in enumerate(names) if name in names[:at])
