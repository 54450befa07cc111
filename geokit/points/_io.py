"""Reading and writing of point clouds and rays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.files import atomic_path, require_extension, require_file
from geokit.errors import FileFormatError, InputError
from geokit.formats.table import FORMATS, extensions, module_of, with_formats

__all__ = ["PointCloud", "Rays", "load", "load_rays", "save"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with named data arrays, validated on construction.

    Args:
        points: Positions [world], shape (N, 3); stored as read-only float64.
        data: Numeric arrays with N rows by name, shape (N,) or (N, K); their types are kept.
    Raises:
        InputError: points is not (N, 3) or not finite, or an array of data is not numeric or does not have N rows.
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
    """Rays: origins (N, 3) [world] and directions (N, 3), float64."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]


@with_formats("points", "r")
def load(path: str | os.PathLike[str], *, finite_only: bool = False) -> PointCloud:
    """Read points and their data arrays from a file.

    Formats: .ply (vertices), .pcd, .vtp (points), .las and .laz (with laspy), .csv, .xyz and .txt (columns named x, y,
    z, else the first three), .pts, .npy ((N, K), the first three columns), .npz (the array ``points``, else the only
    one of shape (N, 3); other arrays with N rows are data) and .obj (vertices).

    Columns ``name_x, name_y, name_z`` become one array (N, 3), ``nx, ny, nz`` the array ``normals``, and
    ``red, green, blue`` of one type the array ``rgb``; unnamed columns are called ``column_3``, ``column_4``, ... Text
    is read as float64, each number rounded correctly.

    In .pcd files ``normal_x, normal_y, normal_z`` become ``normals``, and a packed ``rgb`` or ``rgba`` becomes an array
    of uint8; width, height and viewpoint are not kept, and the viewpoint is not applied. In .pts files the color
    becomes ``rgb`` uint8. Coordinates of .las files are the integers of the file times its scale in float64, within 2
    roundings.

    Args:
        path: {formats}.
        finite_only: Leave out points that are not finite, as scanners write them for rays without an echo, with their
            rows of data. Otherwise such points raise FileFormatError.
    Returns:
        PointCloud.
    Raises:
        InputError: The extension is not one of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged or has no coordinates, or a point is not finite; the message gives the
            row.
        MissingDependencyError: The file is .las or .laz and laspy is not installed.
    Example:
        >>> load("data/samples/cloud.ply")
        PointCloud(20000 points, data: normals)

    Held by: tests/formats/test_damaged_points_stability.py
    """
    kind = require_extension(path, extensions("points", "r"), "point")
    path = require_file(path)
    module = module_of(kind)
    size = module.content_bytes(path) if FORMATS[kind].process else None
    if size is None:
        points, data = module.read_points(path)
    else:
        from geokit.formats import reader_process

        points, data = reader_process.read_points(path, FORMATS[kind].module, size)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        if not finite_only:
            row = int(np.argmax(bad))
            raise FileFormatError(
                f"{path}: point {row} is not finite ({points[row].tolist()}); remove or replace it, or leave out all "
                f"{int(bad.sum())} such points with finite_only=True"
            )
        points, data = points[~bad], {name: values[~bad] for name, values in data.items()}
    return PointCloud(points, data)


@with_formats("rays", "r")
def load_rays(path: str | os.PathLike[str]) -> Rays:
    """Read rays from a .csv, .txt, .xyz, .npy or .npz file.

    Columns are named ox, oy, oz, dx, dy, dz; without these names the first six columns are used. An .npz file holds the
    arrays ``origins`` and ``directions``, or one array of shape (N, 6). Directions need not have unit length.

    Args:
        path: {formats}.
    Returns:
        Rays(origins, directions), each (N, 3) float64.
    Raises:
        InputError: The extension is not one of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged or has no six columns, or a ray is not finite or has a direction of
            length zero; the message gives the row.
    """
    kind = require_extension(path, extensions("rays", "r"), "ray")
    path = require_file(path)
    table = module_of(kind).read_rays(path)
    bad = ~np.isfinite(table).all(axis=1) | ~(table[:, 3:] != 0.0).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(f"{path}: ray {row} has no usable direction or origin ({table[row].tolist()}); remove it")
    return Rays(np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3:]))


@with_formats("points", "w")
def save(
    path: str | os.PathLike[str],
    points: ArrayLike,
    *,
    data: Mapping[str, ArrayLike] | None = None,
    encoding: str | None = None,
) -> None:
    """Write points and their data arrays to a file, replacing it atomically.

    A concurrent reader sees either the old file or the new one.

    .vtp, .csv, .npz, .pcd, .ply (binary), .pts and .xyz all keep float64. .las and .laz hold integers times a scale,
    the least power of ten that covers the extent: coordinates are kept within 1.2e-9 of the extent along their axis
    (plus two roundings).

    In .csv, .ply and .xyz an array (N, 3) becomes the columns ``name_x, name_y, name_z`` (``normals``: nx, ny, nz;
    ``rgb``: red, green, blue); an array of another width becomes ``name_0, name_1, ...``. In .pcd ``normals`` become
    normal_x, normal_y, normal_z, and ``rgb`` (N, 3) and ``rgba`` (N, 4) of uint8 are packed as in PCL. .pcd coordinates
    are 8-byte floats, or 4-byte floats if points is a float32 array, the only ones that PCL and Open3D read. .pts holds
    only ``intensity`` and ``rgb`` uint8. In .las, arrays named after a dimension are stored there, ``rgb`` unchanged
    (LAS expects 16 bits), and all others in extra dimensions.

    Args:
        path: {formats}.
        points: Positions [world], shape (N, 3).
        data: Numeric arrays with N rows by name, shape (N,) or (N, K).
        encoding: Encoding of a .pcd file: "binary", "ascii" or "binary_compressed"; None for "binary".
    Raises:
        InputError: The extension is not one of these, points or data is invalid, the format does not allow a name, or
            the format does not have this encoding.
        FileAccessError: The folder is missing or the file cannot be written.
        MissingDependencyError: The file is .las or .laz and laspy is not installed.
    Example:
        >>> save("grains.pcd", [[0, 0, 0], [1, 0, 0]], data={"radius": [0.5, 0.25]}, encoding="ascii")

    Held by: tests/formats/test_points_pcd_pts_las.py
    """
    kind = require_extension(path, extensions("points", "w"), "point")
    encodings = FORMATS[kind].encodings
    if encoding is not None and encoding not in encodings:
        known = ", ".join(["None", *map(repr, encodings)])
        raise InputError(f"encoding: {encoding!r} is not one of {kind}; use one of {known}")
    cloud = PointCloud(points, data)
    single = FORMATS[kind].single and _is_single(points)
    coordinates = cloud.points.astype(np.float32) if single else cloud.points
    with atomic_path(path) as part:
        module = module_of(kind)
        if encodings:
            module.write_points(part, coordinates, cloud.data, encoding or encodings[0])
        else:
            module.write_points(part, coordinates, cloud.data)


def _is_single(points: ArrayLike) -> bool:
    return getattr(points, "dtype", None) == np.float32


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
