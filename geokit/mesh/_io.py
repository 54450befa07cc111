"""Mesh files in and out, in the formats that geokit/formats/table.py lists."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.files import atomic_path, require_extension, require_file
from geokit.errors import FileFormatError, GeokitError, InputError
from geokit.formats.table import FORMATS, extensions, module_of, with_formats
from geokit.mesh._model import TriangleMesh

__all__ = ["load", "save"]


@with_formats("mesh", "r")
def load(path: str | os.PathLike[str], *, name: str | None = None) -> TriangleMesh:
    """Load a triangle mesh from a file; the extension determines the format.

    Positions are those of the file in float64, in the file's own units and axes. Nothing is merged, moved or dropped:
    unused vertices, duplicates and triangles without area stay. The one exception is .stl, which has no shared corners:
    exactly equal corners are merged. Polygons, also concave ones, are split into triangles that keep their winding. All
    bodies of a file are joined and named in ``parts``; each is moved by its transform (a mirrored body keeps its
    outside). From USD, visible prims of the default and render purposes are read at the default time. From files with
    volume cells, only the surface cells are read.

    Args:
        path: {formats}.
        name: The mesh's name; None is the file's name without its extension.
    Returns:
        TriangleMesh with at least one face.
    Raises:
        InputError: The extension is none of these.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is truncated or damaged, has no faces, has an index out of range or a coordinate that
            is not finite, or its content does not match its extension.
        MissingDependencyError: A USD file without usd-core installed.
    Example:
        >>> load("data/samples/bracket.obj")
        TriangleMesh('bracket', 76 vertices, 152 faces)
    """
    from geokit.formats.polygons import join

    kind = require_extension(path, extensions("mesh", "r"), "mesh")
    path = require_file(path)
    if path.stat().st_size == 0:
        raise FileFormatError(f"{path}: is empty; get a whole copy")
    try:
        if FORMATS[kind].process:
            from geokit.formats import reader_process

            bodies = reader_process.read_mesh(path, FORMATS[kind].module)
        else:
            bodies = module_of(kind).read_mesh(path)
        return join(bodies, path, path.stem if name is None else name)
    except (GeokitError, MemoryError):
        raise
    except Exception as error:
        raise FileFormatError(
            f"{path}: cannot be read as {kind} ({type(error).__name__}: {error}); the file is damaged, export it again"
        ) from error


@with_formats("mesh", "w")
def save(
    path: str | os.PathLike[str],
    mesh: TriangleMesh,
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a mesh, with optional data on its vertices and faces; the extension determines the format.

    The file is replaced atomically: a reader sees either the old file or the new one. Positions keep float64 except in
    .stl, .glb and USD, which store float32 (relative precision 6e-8 of the largest coordinate). Only .obj keeps the
    names of parts.

    Args:
        path: {formats}.
        mesh: The mesh.
        point_data: Arrays (V,) or (V, k) by name, for .vtk .vtp .vtu .msh .xdmf.
        cell_data: Arrays (F,) or (F, k) by name, for the same formats.
    Raises:
        InputError: An unknown extension, a mesh without faces, data for a format that cannot store it, data of a wrong
            shape or type, or coordinates that float32 cannot hold for a format of float32.
        FileAccessError: The target cannot be written.
        MissingDependencyError: A USD file without usd-core installed.
    Example:
        >>> bracket = load("data/samples/bracket.obj")
        >>> save("out.vtp", bracket, point_data={"height": bracket.vertices[:, 2]})
    """
    kind = require_extension(path, extensions("mesh", "w"), "mesh")
    written = FORMATS[kind]
    if not isinstance(mesh, TriangleMesh):
        raise InputError(f"mesh: a {type(mesh).__name__} is not a TriangleMesh; make one from vertices and faces")
    if len(mesh.faces) == 0:
        raise InputError("mesh: has no faces; a mesh file without faces cannot be read back")
    points = _checked(point_data, len(mesh.vertices), "point_data", "vertices")
    cells = _checked(cell_data, len(mesh.faces), "cell_data", "faces")
    if (points or cells) and not written.data:
        known = sorted(other for other in extensions("mesh", "w") if FORMATS[other].data)
        raise InputError(f"{path}: {kind} holds no data arrays; use one of {', '.join(known)}")
    if written.float32:
        _require_float32(mesh, kind)
    with atomic_path(path) as part:
        module = module_of(kind)
        if written.data:
            module.write_mesh(part, mesh, points, cells)
        else:
            module.write_mesh(part, mesh)


def _checked(data: Mapping[str, ArrayLike] | None, count: int, argument: str, rows: str) -> dict[str, NDArray[Any]]:
    checked = {}
    for name, given in (data or {}).items():
        values = np.asarray(given)
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{argument}: the name {name!r} is not a text; give each array a name")
        if values.ndim not in (1, 2) or len(values) != count:
            raise InputError(
                f"{argument}['{name}']: shape {values.shape} is neither ({count},) nor ({count}, k); "
                f"give one row for each of the {count} {rows}"
            )
        checked[name] = _storable(values, f"{argument}['{name}']")
    return checked


def _storable(values: NDArray[Any], where: str) -> NDArray[Any]:
    # The types that all of these formats support; .xdmf and legacy .vtk have neither bool nor 8-bit integers.
    if values.dtype in (np.float32, np.float64):
        return values
    if values.dtype.kind in "bui":
        wide = values.dtype.itemsize > 4 or values.dtype == np.uint32
        if values.dtype == np.uint64 and values.size and values.max() > np.iinfo(np.int64).max:
            raise InputError(f"{where}: {values.max()} is beyond int64; write smaller numbers")
        return values.astype(np.int64 if wide else np.int32)
    raise InputError(f"{where}: dtype {values.dtype} cannot be written; use float32, float64 or integers")


def _require_float32(mesh: TriangleMesh, kind: str) -> None:
    largest = np.abs(mesh.vertices).max(axis=1)
    if largest.max() > np.finfo(np.float32).max:
        row = int(np.argmax(largest))
        raise InputError(
            f"mesh: vertex {row} ({mesh.vertices[row].tolist()}) is beyond the float32 of {kind}; save as .ply or .vtp"
        )
