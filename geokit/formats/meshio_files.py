"""Gmsh .msh and .xdmf through meshio, which reads in a separate process; also writes .vtu."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.body import Body

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "write_mesh"]

_SURFACE = {"triangle", "quad", "polygon"}
# meshio's dimensions of second-order cells are right, but the cells themselves are not polygons.
_IGNORED_DIMENSIONS = (0, 1)


def read_mesh(path: Path) -> list[Body]:
    """Read the triangles, quads and polygons of the file; points, lines and inner volume cells are left out."""
    import meshio

    mesh = meshio.read(str(path))
    counts: list[np.ndarray] = []
    indices: list[np.ndarray] = []
    volume: dict[str, int] = {}
    for block in mesh.cells:
        if block.type in _SURFACE:
            rows = [np.asarray(row, np.int64) for row in block.data] if block.type == "polygon" else block.data
            counts.append(np.fromiter(map(len, rows), np.int64, len(rows)))
            indices.append(np.concatenate(rows) if len(rows) else np.zeros(0, np.int64))
        elif block.dim == 2:
            raise FileFormatError(
                f"{path}: holds '{block.type}' cells, which are not polygons; export first-order triangles or quads"
            )
        elif block.dim not in _IGNORED_DIMENSIONS:
            volume[block.type] = volume.get(block.type, 0) + len(block.data)
    if not counts:
        what = ", ".join(f"{count} {kind}" for kind, count in volume.items()) or f"{len(mesh.points)} points"
        raise FileFormatError(f"{path}: holds {what} but no surface cells; extract the surface and export that")
    points = np.asarray(mesh.points, np.float64)
    if points.shape[1] == 2:
        points = np.pad(points, ((0, 0), (0, 1)))
    return [Body(points, np.concatenate(counts), np.concatenate(indices).astype(np.int64))]


def write_mesh(
    path: Path, mesh: TriangleMesh, point_data: Mapping[str, NDArray], cell_data: Mapping[str, NDArray]
) -> None:
    """Write VTK .vtu, Gmsh .msh 4.1 (both binary), and .xdmf in one file, through meshio."""
    import meshio

    kind = path.suffix.lower()
    content = meshio.Mesh(
        np.array(mesh.vertices),
        [("triangle", np.array(mesh.faces))],
        point_data={name: np.array(values) for name, values in point_data.items()},
        cell_data={name: [np.array(values)] for name, values in cell_data.items()},
    )
    # Inline, because a second file for the arrays could not be replaced atomically together with the first.
    options = {"data_format": "XML"} if kind == ".xdmf" else {}
    file_format = {".vtu": "vtu", ".msh": "gmsh", ".xdmf": "xdmf"}[kind]
    # meshio prints advice to standard output and warns about its own choices, so both are suppressed.
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        meshio.write(path, content, file_format=file_format, **options)
