"""Reading and writing of point clouds and rays."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit._warn import warn
from geokit.core.content_limit import content_limit, require_content
from geokit.core.files import atomic_path, extension, named_damage, refuse_empty, require_file
from geokit.core.interop.notebook import repr_html, show
from geokit.core.interop.objects import arrays_of, host, points_of
from geokit.core.memory.needs import file_size, needs, rows
from geokit.core.require import (
    described,
    read_array,
    require_flag,
    require_instance,
    require_mapping,
    require_path,
    require_text,
)
from geokit.errors import FileFormatError, InputError
from geokit.formats import las
from geokit.formats.foreign import require_format
from geokit.formats.las import CoordinateSystem
from geokit.formats.table import FORMATS, module_of, with_formats

# Copies of a .vdb's content: OpenVDB's tree, columns, the cloud; bytes of a point while it is sorted into a tree; and
# those that OpenVDB and its compression take for any file, without which they end the process.
TREE_COPIES, TREE_ROW, TREE_BYTES = 6, 200, 16 << 20
# Of VTK's libraries, which are mapped at first use and end the process where there is no room for them.
VTK_BYTES = 20 << 20
# Of columns with or without names: no rows are no points.
TABLES = (".csv", ".txt", ".xyz")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with named data arrays, validated on construction.

    Args:
        points: Positions [world], shape (N, 3), or a cloud of another library; stored as read-only float64.
        data: Numeric arrays with N rows by name, shape (N,) or (N, K); their types are kept. None takes those that a
            cloud of another library carries, colors as ``rgb`` or ``rgba``; a UserWarning names what is left out.
        coordinate_system: That of a .las or .laz file, with its ``name`` and its ``records``; None if it is not known.
    Raises:
        InputError: points is not (N, 3) or not finite, an array of data is not numeric or does not have N rows, or
            coordinate_system is something else.
    Example:
        >>> cloud = PointCloud([[0, 0, 5], [1, 0, 9]], {"classification": [2, 6]})
        >>> cloud[cloud.data["classification"] == 2]
        PointCloud(1 points, data: classification)
    """

    points: NDArray[np.float64]
    data: Mapping[str, NDArray[np.generic]]
    coordinate_system: CoordinateSystem | None = None

    @needs()
    def __init__(
        self,
        points: ArrayLike,
        data: Mapping[str, ArrayLike] | None = None,
        coordinate_system: CoordinateSystem | None = None,
    ) -> None:
        table = _points(points)
        if data is None:
            given, lost = arrays_of(points, len(table), "points")
            if lost:
                held = ", ".join(map(repr, lost))
                warn(f"points: {held} of {type(points).__name__} are left out")
        else:
            given = require_mapping(data, "data", blank=True)
        arrays = {name: _data(values, name, len(table)) for name, values in given.items()}
        object.__setattr__(self, "points", table)
        object.__setattr__(self, "data", MappingProxyType(arrays))
        if coordinate_system is not None:
            require_instance(coordinate_system, "coordinate_system", CoordinateSystem, "take that of a loaded cloud")
        object.__setattr__(self, "coordinate_system", coordinate_system)

    def __reduce__(self) -> Any:
        return PointCloud, (self.points, dict(self.data), self.coordinate_system)

    def __getitem__(self, rows: ArrayLike | slice) -> PointCloud:
        """Some of the points with their arrays, as NumPy chooses rows: a slice, a mask (N,), or numbers of rows.

        Raises:
            InputError: ``rows`` is not one of these.
        """
        chosen: Any = rows
        if not isinstance(rows, slice):
            chosen = np.asarray(rows) if np.size(rows) else np.zeros(0, np.intp)
            is_mask = chosen.dtype.kind == "b"
            if chosen.ndim != 1 or chosen.dtype.kind not in "biu" or (is_mask and len(chosen) != len(self)):
                raise InputError(
                    f"rows: {described(rows)} is not a slice, a mask of {len(self)} rows, or numbers of rows (K,)"
                )
        try:
            taken = {name: values[chosen] for name, values in self.data.items()}
            return PointCloud(self.points[chosen], taken, self.coordinate_system)
        except IndexError as error:
            raise InputError(f"rows: {error}; the cloud has {len(self)} points") from None

    def __len__(self) -> int:
        return len(self.points)

    _repr_html_ = repr_html
    show = show

    def __repr__(self) -> str:
        return f"PointCloud({len(self.points)} points, data: {', '.join(self.data) or 'none'})"


class Rays(NamedTuple):
    """Rays: origins (N, 3) [world] and directions (N, 3), float64."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]


def _load_bytes(path: Any, *, trusted: bool = False, **_: Any) -> float:
    kind = extension(path)
    if kind == ".vdb":
        return TREE_BYTES + TREE_COPIES * file_size(path)
    return 2 * file_size(path) + (VTK_BYTES if trusted and kind == ".vtp" else 0)


@needs(_load_bytes, fatal=True)
@with_formats("points", "r")
def load(
    path: str | os.PathLike[str],
    *,
    grid: str | None = None,
    columns: Sequence[str] | None = None,
    finite_only: bool = False,
    trusted: bool = False,
    memory_limit: int | None = None,
) -> PointCloud:
    """Read points and their data arrays from a file.

    Formats: .ply (vertices), .pcd, .vtp (points), .las and .laz (with laspy), .csv, .xyz and .txt (see below), .pts,
    .npy ((N, K), the first three columns), .npz (the array ``points``, else the only one of shape (N, 3); other arrays
    with N rows are data), .e57 (with pye57), .bin (KITTI's x, y, z and reflectance in float32; of nuScenes if the name
    ends in .pcd.bin), .vdb (OpenVDB's grids of points) and .obj (vertices and the colors behind them).

    Columns ``name_x, name_y, name_z`` become one array (N, 3), ``nx, ny, nz`` the array ``normals``, and
    ``red, green, blue`` of one type (also ``Red``, ``R`` or ``r`` and so on) the array ``rgb``; unnamed columns are
    called ``column_3``, ``column_4``, ... Text is read as float64, each number rounded correctly, but ``rgb`` of whole
    numbers above 1 as uint8 or uint16.

    In .csv, .xyz and .txt a first line without any number is a header. The coordinates are the columns called x, y and
    z, in either case and with a unit (``X [m]``); else those of the only position (``pos_x``, ``position.x``,
    ``Points:0``, ``x_coord``); else easting, northing and height, elevation or altitude. A header without any of these
    is an error that lists its names; ``columns`` then chooses. Without a header they are the first three columns.
    Columns of text are left out with a warning. Words such as nan, N/A and -nan(ind) are NaN, and so are empty cells
    outside of the coordinates. Exponents may be Fortran's (1.5D+00).

    In .pcd files ``normal_x, normal_y, normal_z`` become ``normals``, and a packed ``rgb`` or ``rgba`` becomes an array
    of uint8; width, height and viewpoint are not kept, and the viewpoint is not applied. In .pts files the color
    becomes ``rgb`` uint8. Coordinates of .las files are the integers of the file times its scale in float64, within 2
    roundings. The scans of an .e57 are moved to their poses and joined, without the points that it declares invalid;
    ``scan`` is the number of a point's scan where there are several.

    Points of a .vdb come in the order of its voxels, with all attributes that are numbers; ``N`` becomes ``normals``,
    ``Cd`` becomes ``rgb``, and a group becomes an array of bool. Other attributes are left out with a warning.

    Args:
        path: {formats}.
        grid: Of a .vdb: name of the grid of points; None if there is one.
        columns: Of a .csv, .xyz or .txt: names of the columns of x, y and z, as in ("east", "north", "up"). Columns
            without names are called ``column_0``, ``column_1``, ... None finds them by their names.
        finite_only: Leave out points that are not finite, as scanners write them for rays without an echo, with their
            rows of data. Otherwise such points raise FileFormatError.
        trusted: Whether a .vtp, .laz, .e57 or .vdb file is known to be sound. It is then read in this process, which
            saves a copy; a crash of the library is one of this process, and no limit on time and memory applies.
        memory_limit: Largest size of the decompressed content [bytes]; None is a hundred times the file's size, at
            least 1 GiB, and at most half of the free memory.
    Returns:
        PointCloud.
    Raises:
        InputError: The extension is not one of these, the .vdb has no such grid of points, or several and none is
            named; or columns are not three names of columns of the table.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged, has no coordinates or none that its names tell, or a point is not
            finite; the message gives the row.
        DeviceMemoryError: The content is larger than memory_limit.
        MissingDependencyError: The file is .las or .laz and laspy is not installed, or .e57 and pye57 is not, or .vdb
            without the OpenVDB extension.
        WorkerError: The separate process that reads a .vtp, .laz, .e57 or .vdb file did not start, or was killed from
            outside.
    Example:
        >>> load("data/samples/cloud.ply")
        PointCloud(20000 points, data: normals)
    """
    return load_counted(
        path, grid=grid, columns=columns, finite_only=finite_only, trusted=trusted, memory_limit=memory_limit
    )[0]


def load_counted(
    path: str | os.PathLike[str],
    *,
    grid: str | None = None,
    columns: Sequence[str] | None = None,
    finite_only: bool = False,
    trusted: bool = False,
    memory_limit: int | None = None,
) -> tuple[PointCloud, int]:
    """The points of :func:`load`, and the number of those that were left out."""
    require_flag(finite_only, "finite_only")
    require_flag(trusted, "trusted")
    kind = require_format(path, "points", "r", "point")
    if grid is not None:
        require_text(grid, "grid")
        if kind != ".vdb":
            raise InputError(f"grid: {kind} holds one cloud; leave it out")
    if columns is not None:
        columns = _names(columns, kind, 3)
    path = require_file(path)
    if kind not in TABLES:
        refuse_empty(path)
    if kind == ".vdb":
        from geokit.native import _points as vdb_points

        limit = content_limit(path.stat().st_size, memory_limit)
        return _finite(path, *vdb_points.read(path, grid, limit, trusted), finite_only=finite_only)
    module = module_of(kind)
    with named_damage(path):
        size, limit = _sizes(path, module, memory_limit)
        if size is None or not FORMATS[kind].process:
            points, data = module.read_points(path) if columns is None else module.read_points(path, columns)
        elif trusted:
            from geokit.formats.reader import trusted as in_process

            points, data = in_process.read_points(path, module)
        else:
            from geokit.formats.reader import process as reader_process

            points, data = reader_process.read_points(path, module.__name__, limit)
    cloud, left_out = _finite(path, points, data, finite_only=finite_only)
    if kind in (".las", ".laz"):
        cloud = PointCloud(cloud.points, cloud.data, las.coordinate_system(path))
    return cloud, left_out


def _names(columns: Any, kind: str, count: int) -> tuple[str, ...]:
    """Names of so many columns.

    Raises:
        InputError: They are others, or the format is no table.
    """
    if kind not in TABLES:
        raise InputError(f"columns: {kind} says itself which numbers are coordinates; leave it out")
    number, example = {3: "three", 6: "six"}[count], ", ".join(map(repr, "abcdef"[:count]))
    if isinstance(columns, str) or not isinstance(columns, Sequence):
        raise InputError(f"columns: {described(columns)} is not a list of {number} names; use ({example})")
    for name in columns:
        require_text(name, "columns")
    if len(columns) != count or len(set(columns)) != count:
        raise InputError(f"columns: {described(columns)} is not {number} different names; use ({example})")
    return tuple(columns)


def _finite(
    path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]], *, finite_only: bool
) -> tuple[PointCloud, int]:
    """The cloud of the finite points, and the number of the others."""
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        if not finite_only:
            row = int(np.argmax(bad))
            raise FileFormatError(
                f"{path}: point {row} is not finite ({points[row].tolist()}); remove or replace it, or leave out all "
                f"{int(bad.sum())} such points with finite_only=True"
            )
        points, data = points[~bad], {name: values[~bad] for name, values in data.items()}
    return PointCloud(points, data), int(bad.sum())


def _sizes(path: Path, module: ModuleType, memory_limit: int | None) -> tuple[int | None, int]:
    """Size of the content, as the module's ``content_bytes`` tells it, and the limit that it keeps."""
    limit = content_limit(path.stat().st_size, memory_limit)
    size = module.content_bytes(path) if hasattr(module, "content_bytes") else 0
    require_content(path, size or path.stat().st_size, limit)
    return size, limit


@needs(lambda path, **_: 2 * file_size(path))
@with_formats("rays", "r")
def load_rays(
    path: str | os.PathLike[str], *, columns: Sequence[str] | None = None, memory_limit: int | None = None
) -> Rays:
    """Read rays from a .csv, .txt, .xyz, .npy or .npz file.

    Columns are named ox, oy, oz, dx, dy, dz; x, origin_x, pos.x or start:0 and dir_x or direction.x are known too. A
    header with other names is an error that lists them; ``columns`` then chooses. Without names the first six columns
    are used. An .npz file holds the arrays ``origins`` and ``directions``, or one array of shape (N, 6). Directions
    need not have unit length.

    Args:
        path: {formats}.
        columns: Of a .csv, .xyz or .txt: names of the six columns, origins first.
        memory_limit: As for :func:`load`.
    Returns:
        Rays(origins, directions), each (N, 3) float64.
    Raises:
        InputError: The extension is not one of these, or columns are not six names of columns of the table.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The content is damaged or has no six columns, the names are not those of rays, or a ray is not
            finite or has a direction of length zero; the message gives the row.
        DeviceMemoryError: The content is larger than memory_limit.
    """
    kind = require_format(path, "rays", "r", "ray")
    if columns is not None:
        columns = _names(columns, kind, 6)
    path = require_file(path)
    module = module_of(kind)
    with named_damage(path):
        _sizes(path, module, memory_limit)
        table = module.read_rays(path) if columns is None else module.read_rays(path, columns)
    bad = ~np.isfinite(table).all(axis=1) | ~(table[:, 3:] != 0.0).any(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise FileFormatError(f"{path}: ray {row} has no usable direction or origin ({table[row].tolist()}); remove it")
    return Rays(np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3:]))


@needs(lambda path, points, **_: (TREE_ROW if extension(path) == ".vdb" else 48) * rows(points), fatal=True)
@with_formats("points", "w")
def save(
    path: str | os.PathLike[str],
    points: ArrayLike | PointCloud,
    *,
    data: Mapping[str, ArrayLike] | None = None,
    encoding: str | None = None,
) -> None:
    """Write points and their data arrays to a file, replacing it atomically.

    A concurrent reader sees either the old file or the new one.

    .vtp, .csv, .npz, .pcd, .ply (binary), .pts and .xyz all keep float64. .las and .laz hold integers times a scale,
    the least power of ten that covers the extent: coordinates are kept within 1.2e-9 of the extent along their axis
    (plus two roundings). A .vdb holds one grid of points called "points", in the order of its voxels. Their edge is
    chosen for about 8 points each, and is at least 1.6e-5 and 1.5e-8 of the largest coordinate; a position is kept
    within 1.5e-8 of an edge. ``rgb`` of integers is stored as Houdini's ``Cd`` from 0 to 1 and read back unchanged.

    In .csv, .ply and .xyz an array (N, 3) becomes the columns ``name_x, name_y, name_z`` (``normals``: nx, ny, nz;
    ``rgb``: red, green, blue, in .ply as uint8 where floats are k / 255 exactly, others with a UserWarning); an array
    of another width becomes ``name_0, name_1, ...``. In .pcd ``normals`` become normal_x, normal_y, normal_z, and
    ``rgb`` (N, 3) and ``rgba`` (N, 4) of uint8 are packed as in PCL. .pcd coordinates are 8-byte floats, or 4-byte
    floats if points is a float32 array, the only ones that PCL and Open3D read. .pts holds only ``intensity`` and
    ``rgb`` uint8. In .las, arrays named after a dimension are stored there, ``rgb`` in 16 bits, and
    all others in extra dimensions. Colors of .las and .laz have 16 bits, those of .pcd and .pts 8: full stays full,
    whether ``rgb`` is of floats from 0 to 1, uint8 or uint16. .las and .laz keep the coordinate system of a cloud that
    comes from one; ``gps_time`` beyond a week is marked as standard time. Other formats hold no coordinate system,
    which a UserWarning says.

    Args:
        path: {formats}.
        points: Positions [world], shape (N, 3), or a cloud of another library.
        data: Numeric arrays with N rows by name, shape (N,) or (N, K); None takes those of a cloud.
        encoding: Encoding of a .pcd file: "binary", "ascii" or "binary_compressed"; None for "binary".
    Raises:
        InputError: The extension is not one of these, points or data is invalid, the format does not allow a name, or
            the format does not have this encoding.
        FileAccessError: The folder is missing or the file cannot be written.
        MissingDependencyError: The file is .las or .laz and laspy is not installed, or .vdb without the OpenVDB
            extension.
    Example:
        >>> save("grains.pcd", [[0, 0, 0], [1, 0, 0]], data={"radius": [0.5, 0.25]}, encoding="ascii")
    """
    kind = require_format(path, "points", "w", "point")
    encodings = FORMATS[kind].encodings
    if encoding is not None and (not isinstance(encoding, str) or encoding not in encodings):
        known = ", ".join(["None", *map(repr, encodings)])
        raise InputError(f"encoding: {described(encoding)} is not one of {kind}; use one of {known}")
    system = None
    if isinstance(points, PointCloud):
        system, data, points = points.coordinate_system, points.data if data is None else data, points.points
    cloud = PointCloud(points, data)
    if system is not None and system.records and kind not in (".las", ".laz"):
        warn(f"{kind} holds no coordinate system; {system.name or 'that of the cloud'} is left out")
    single = FORMATS[kind].single and getattr(points, "dtype", None) == np.float32
    coordinates = cloud.points.astype(np.float32) if single else cloud.points
    with atomic_path(path) as part:
        if kind == ".vdb":
            from geokit.native import _points as vdb_points

            vdb_points.write(part, cloud.points, cloud.data, require_path(path))
            return
        module = module_of(kind)
        if kind in (".las", ".laz"):
            module.write_points(part, coordinates, cloud.data, system)
        elif encodings:
            module.write_points(part, coordinates, cloud.data, encoding or encodings[0])
        else:
            module.write_points(part, coordinates, cloud.data)


def _points(values: ArrayLike) -> NDArray[np.float64]:
    table = np.array(host(points_of(values, "points"), "points"), dtype=np.float64)
    if table.size == 0 and table.ndim <= 2:
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
    array = np.array(read_array(values, f"data['{name}']", kinds="fiub"))
    if array.ndim not in (1, 2) or len(array) != count:
        raise InputError(f"data: '{name}' has shape {array.shape}; give one row for each of the {count} points")
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:  # no file holds them, and text would hold their repr
        array = array.astype(np.float64)
    array.flags.writeable = False
    return array
