"""Points, meshes and dense volumes of other libraries, recognized by their attributes, without an import.

A trimesh, pyvista, meshio or Open3D object is read by its attributes. The functions here only find the arrays; what
comes of them is checked where geokit's own objects are made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop.arrays import import_array, is_exporter
from geokit.core.require import read_array
from geokit.errors import InputError

# Of meshio's cells: those that bound nothing, and those that are polygons.
_LOWER = {"vertex", "line", "line3"}
POLYGON_CELLS = {"triangle": 3, "quad": 4, "polygon": 0}
# Coordinates of an axis may differ by this share of the step from equal steps; float32 coordinates do.
LARGEST_JITTER = 1e-3


class Polygons(NamedTuple):
    """A surface: points (V, 3), corners of each polygon (P,), and the vertex indices of all corners, one after another.

    ``faces`` is given in place of both where all polygons have equally many corners: shape (F, K). ``source`` is the
    object that was read: a scene is joined first, strips become triangles. ``notes`` says what was left out.
    """

    points: Any
    faces: NDArray[Any] | None = None
    counts: Any = None
    indices: Any = None
    source: Any = None
    notes: tuple[str, ...] = ()


class Image(NamedTuple):
    """A dense volume: values (X, Y, Z) or (X, Y, Z, C), index of the first voxel, index to world (4, 4), and a name."""

    values: Any
    origin: tuple[int, ...]
    transform: NDArray[np.float64]
    name: str


def points_of(values: Any, name: str) -> Any:
    """The array of points that an object holds; anything else is returned as it is.

    Objects that say what their points are: ``points`` (geokit's PointCloud, pyvista, meshio, Open3D),
    ``point.positions`` (Open3D's tensors), or ``vertices`` without faces (trimesh's PointCloud).

    Raises:
        InputError: It is a mesh, whose points could be its vertices or lie anywhere on it.
    """
    if isinstance(values, (np.ndarray, list, tuple, int, float, str)) or _is_array(values):
        return values
    found = attribute(values, "points")
    if found is None:
        found = attribute(attribute(values, "point"), "positions")
    if found is not None:
        return found
    vertices = attribute(values, "vertices")
    if vertices is None:
        vertices = attribute(attribute(values, "vertex"), "positions")
    if vertices is None:
        return values
    if polygons_of(values, name) is not None:
        raise InputError(
            f"{name}: {_kind(values)} is a mesh; give its vertices, or points on its surface (mesh.sample_surface)"
        )
    return vertices


def arrays_of(values: Any, count: int, name: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays with a row for each point that a cloud carries, by geokit's names, and the names of those left out.

    Colors and normals of Open3D, all its tensors, the point data of pyvista and meshio, colors of trimesh's PointCloud.

    Args:
        values: What :func:`points_of` takes.
        count: Number of its points.
        name: The argument's name for error messages.
    """
    if isinstance(values, (np.ndarray, list, tuple, int, float, str)) or _is_array(values):
        return {}, []
    given = attribute(values, "data")
    visual = attribute(values, "visual")
    if not isinstance(given, Mapping):
        given = attribute(values, "point_data")
    if given is None:
        given = attribute(values, "point")
    if visual is not None:
        given = {"rgba": visual.vertex_colors} if attribute(visual, "kind") == "vertex" else {}
    elif given is None:
        given = {label: attribute(values, label) for label in ("normals", "colors")}
    normals = {} if (mark := attribute(given, "active_normals_name")) is None else {mark: "normals"}
    items = given.items() if callable(getattr_or_none(given, "items")) else vars(given).items()
    found, lost = dict[str, NDArray[Any]](), list[str]()
    for theirs, rows in items:
        if rows is None or theirs == "positions":
            continue
        try:
            array = host(rows, name)
        except InputError:  # text
            array = np.asarray(rows)
        label = normals.get(theirs, "rgb" if theirs == "colors" else str(theirs))
        array = array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array
        if array.dtype.kind in "fiub" and array.ndim in (1, 2) and len(array) == count:
            found[label] = array
        elif len(array):  # empty ones of Open3D are none
            lost.append(label)
    return found, lost


def polygons_of(value: Any, name: str) -> Polygons | None:
    """The surface that an object holds; None if it holds none.

    Objects with ``vertices`` and ``faces`` or ``triangles`` (trimesh, Open3D, and most others), with ``vertex`` and
    ``triangle`` tensors (Open3D), with ``points`` and padded ``faces`` (pyvista) or ``cells`` (meshio), scenes that can
    be joined (trimesh), and pairs of arrays (vertices, faces).

    Raises:
        InputError: The object holds cells that are not polygons.
    """
    if isinstance(value, (tuple, list)):
        return Polygons(value[0], host(value[1], name)) if len(value) == 2 else None
    if isinstance(value, (np.ndarray, str, int, float)) or _is_array(value):
        return None
    join, bodies, others = getattr_or_none(value, "to_mesh"), attribute(value, "geometry"), dict[str, Any]()
    if callable(join) and bodies is not None:
        kinds = [type(body).__name__ for body in bodies.values() if attribute(body, "faces") is None]
        value, others = join(), {kind: kinds.count(kind) for kind in kinds}
    vertices = attribute(value, "vertices")
    faces = attribute(value, "faces")
    if vertices is not None:
        faces = attribute(value, "triangles") if faces is None else faces
        return None if faces is None else Polygons(vertices, host(faces, name), None, None, value, _left_out(others))
    vertices = attribute(attribute(value, "vertex"), "positions")
    if vertices is not None:
        faces = attribute(attribute(value, "triangle"), "indices")
        return None if faces is None else Polygons(vertices, host(faces, name), source=value)
    points = attribute(value, "points")
    if points is None:
        return None
    others = {"points": attribute(value, "n_verts"), "lines": attribute(value, "n_lines")}
    if attribute(value, "strips") is not None and np.size(value.strips):
        value = value.triangulate()
        points, faces = value.points, value.faces
    if faces is not None and np.ndim(faces) == 1:
        return _padded(points, np.asarray(faces), value, name)._replace(notes=_left_out(others))
    cells = attribute(value, "cells")
    return _blocks(points, cells, value, name) if isinstance(cells, list) else None


def has_faces(value: Any, name: str) -> bool:
    """Whether a mesh of another library is given, with faces; pairs and lists of points are none."""
    if isinstance(value, (tuple, list)):
        return False
    found = polygons_of(value, name)
    return found is not None and len(found.counts if found.faces is None else found.faces) > 0


def image_of(values: Any, name: str) -> Image | None:
    """The dense volume that an object holds: pyvista's ImageData, or xarray's DataArray; None if it is neither.

    Raises:
        InputError: It has several arrays and none is active, or its voxels are not evenly spaced.
    """
    if isinstance(values, np.ndarray):
        return None
    if attribute(values, "dims") is not None and attribute(values, "coords") is not None:
        return _from_labeled(values, name)
    if attribute(values, "spacing") is not None and attribute(values, "dimensions") is not None:
        return _from_image_data(values, name)
    return None


def _padded(points: Any, faces: NDArray[Any], value: Any, name: str) -> Polygons:
    """Polygons from pyvista's row of counts, each before the corners that it counts."""
    if len(faces) and len(faces) % 4 == 0 and (faces[::4] == 3).all():
        return Polygons(points, faces.reshape(-1, 4)[:, 1:], source=value)
    if not len(faces):
        return Polygons(points, np.zeros((0, 3), np.int64), source=value)
    counts, at = [], 0
    while at < len(faces):
        counts.append(int(faces[at]))
        at += counts[-1] + 1
        if counts[-1] < 0 or at > len(faces):
            raise InputError(f"{name}: the faces of {_kind(value)} end within a polygon; build it again")
    starts = np.cumsum([0, *counts[:-1]]) + np.arange(len(counts))
    return Polygons(points, None, np.array(counts), np.delete(faces, starts), value)


def _left_out(counts: Mapping[str, Any], word: str = "") -> tuple[str, ...]:
    listed = ", ".join(f"{kind}{word} ({count})" for kind, count in counts.items() if count)
    return (f"its {listed} are left out",) if listed else ()


def _blocks(points: Any, cells: list[Any], value: Any, name: str) -> Polygons | None:
    """Polygons from meshio's blocks of cells; lines, points and the cells of volumes are left out, with a note."""
    counts, indices, others = [], [], dict[str, int]()
    for block in cells:
        kind = str(attribute(block, "type"))
        if kind not in POLYGON_CELLS:
            others[kind] = others.get(kind, 0) + len(block.data)
            continue
        rows = [np.asarray(row) for row in block.data]
        counts += [len(row) for row in rows]
        indices += rows
    if not counts:
        held = ", ".join(sorted(others.keys() - _LOWER)) or "no cells"
        raise InputError(f"{name}: {_kind(value)} holds {held} and no polygons; extract its surface")
    return Polygons(points, None, np.array(counts), np.concatenate(indices), value, _left_out(others, " cells"))


def _from_image_data(image: Any, name: str) -> Image:
    points, cells = attribute(image, "point_data"), attribute(image, "cell_data")
    field = attribute(image, "active_scalars_name")
    if field is None:
        names = [*points.keys(), *cells.keys()]
        if len(names) != 1:
            held = ", ".join(map(repr, names)) or "no array"
            raise InputError(f"{name}: {_kind(image)} holds {held}, none active; choose with set_active_scalars(name)")
        field = names[0]
        of_points = field in points.keys()  # noqa: SIM118 (its own mapping)
    else:
        info = attribute(image, "active_scalars_info")
        of_points = getattr(getattr(info, "association", None), "name", "POINT") == "POINT"
    array = np.asarray((points if of_points else cells)[field])
    shape = tuple(int(n) if of_points else max(int(n) - 1, 1) for n in image.dimensions)
    values = (
        array.reshape(*shape, *array.shape[1:], order="F")
        if array.ndim == 1
        else np.stack([column.reshape(shape, order="F") for column in array.T], axis=-1)
    )
    direction = attribute(image, "direction_matrix")
    transform = np.eye(4)
    transform[:3, :3] = (np.eye(3) if direction is None else np.asarray(direction)) * np.asarray(image.spacing)
    # The value of a cell stands at its middle.
    shift = 0.0 if of_points else 0.5 * (np.array(image.dimensions) > 1)
    transform[:3, 3] = np.asarray(image.origin) + transform[:3, :3] @ np.broadcast_to(shift, 3)
    offset = attribute(image, "offset")
    origin = (0, 0, 0) if offset is None else tuple(int(n) for n in offset)
    return Image(values, origin, transform, str(field))


def _from_labeled(array: Any, name: str) -> Image:
    dims = [str(dim) for dim in array.dims]
    lowered = [dim.lower() for dim in dims]
    # Dimensions that are called x, y and z are told by name; others by place.
    space = [lowered.index(axis) for axis in "xyz"] if set("xyz") <= set(lowered) else list(range(min(3, len(dims))))
    if len(space) != 3 or len(dims) > 4:
        raise InputError(f"{name}: {_kind(array)} has the dimensions {', '.join(dims)}; a volume has x, y and z")
    values = np.asarray(array.values).transpose([*space, *(at for at in range(len(dims)) if at not in space)])
    steps = [_even_steps(array, array.dims[at], name) for at in space]
    attributes = attribute(array, "attrs") or {}
    if "transform" in attributes:
        # As to_xarray writes it where axes are not those of the world: coordinates are then voxel indices.
        matrix = read_array(attributes["transform"], f"{name}.attrs['transform']", np.float64).reshape(4, 4)
        return Image(values, tuple(round(start) for start, _ in steps), matrix, str(attribute(array, "name") or ""))
    transform = np.diag([*(step for _, step in steps), 1.0])
    transform[:3, 3] = [start for start, _ in steps]
    return Image(values, (0, 0, 0), transform, str(attribute(array, "name") or ""))


def _even_steps(array: Any, dim: Any, name: str) -> tuple[float, float]:
    """First coordinate and step of a dimension; without coordinates they are 0 and 1."""
    if dim not in array.coords:
        return 0.0, 1.0
    where = read_array(np.asarray(array.coords[dim]), f"{name}.coords['{dim}']", np.float64)
    if len(where) < 2:
        return float(where[0]) if len(where) else 0.0, 1.0
    step = float(where[-1] - where[0]) / (len(where) - 1)
    away = np.abs(np.diff(where) - step)
    if not np.isfinite(step) or step == 0.0 or away.max() > LARGEST_JITTER * abs(step):
        raise InputError(f"{name}: the coordinates along '{dim}' are not evenly spaced; interpolate to even ones")
    return float(where[0]), step


def host(values: Any, name: str, kinds: str = "fiu") -> NDArray[Any]:
    """An array of any library in host memory, of one of NumPy's ``kinds``."""
    if not isinstance(values, np.ndarray) and is_exporter(values):
        values = np.asarray(import_array(values, name).numpy())
    return read_array(values, name, kinds=kinds)


def _is_array(value: Any) -> bool:
    return is_exporter(value) or getattr_or_none(value, "__array__") is not None


def attribute(value: Any, name: str) -> Any:
    """The value of an attribute; None for methods, and where there is none."""
    found = getattr_or_none(value, name)
    return None if callable(found) and not hasattr(found, "__len__") else found


def getattr_or_none(value: Any, name: str) -> Any:
    try:
        return getattr(value, name, None)
    except Exception:  # of the other library
        return None


def _kind(value: Any) -> str:
    return f"{type(value).__module__.partition('.')[0]}'s {type(value).__name__}"
