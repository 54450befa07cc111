"""Meshes in .vtk, .vtp and .vtu, through VTK. Runs in the reader process."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from geokit.formats.mesh_reader_worker import Refusal, WireBody

__all__ = ["read"]

# VTK's cell types: lines and points are left out beside faces.
_LOWER = (0, 1, 2, 3, 4, 21, 35, 68, 75)
_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = 5, 6, 7, 8, 9
_CURVED = (22, 23, 28, 30, 32, 34, 36, 37, 69, 70, 76, 77)
_VOLUME_NAMES = {10: "tetrahedra", 11: "voxels", 12: "hexahedra", 13: "wedges", 14: "pyramids", 42: "polyhedra"}


def read(path: str) -> list[WireBody]:
    """The triangles, quads, polygons and strips of the file; points, lines and volume cells are left out."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    said = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(said)
    data = _data_set(path)
    # VTK reports a damaged file as text and hands back what it has: an error is only there.
    message = " ".join(said.GetOutput().split())
    if "ERR" in message or "Error" in message or data is None:
        raise Refusal(f"cannot be read ({message[-300:] or 'no data'}); the file is damaged, export it again")
    if data.GetNumberOfPoints() == 0:
        raise Refusal("holds no points; a mesh needs faces, export the surface itself")
    kind = data.GetClassName()
    if kind == "vtkPolyData":
        cells = _poly_data(data, vtk_to_numpy)
    elif kind == "vtkUnstructuredGrid":
        cells = _grid(data, vtk_to_numpy)
    else:
        raise Refusal(f"holds a {kind}, which is not a surface; extract its surface and export that")
    points = np.ascontiguousarray(vtk_to_numpy(data.GetPoints().GetData()), "<f8")
    counts, indices = (np.ascontiguousarray(values, "<i8") for values in cells)
    return [WireBody("", (("<f8", points.tobytes()), ("<i8", counts.tobytes()), ("<i8", indices.tobytes())))]


def _data_set(path: str) -> Any:
    from vtkmodules import vtkIOLegacy, vtkIOXML

    reader: Any
    if path.lower().endswith(".vtk"):
        reader = vtkIOLegacy.vtkGenericDataObjectReader()
    elif path.lower().endswith(".vtp"):
        reader = vtkIOXML.vtkXMLPolyDataReader()
    else:
        reader = vtkIOXML.vtkXMLUnstructuredGridReader()
    reader.SetFileName(path)
    reader.Update()
    if reader.GetErrorCode():
        raise Refusal(f"cannot be read (VTK's error {reader.GetErrorCode()}); the file is damaged, export it again")
    return reader.GetOutput()


def _poly_data(data: Any, to_numpy: Any) -> tuple[np.ndarray, np.ndarray]:
    polys = data.GetPolys()
    counts = np.diff(to_numpy(polys.GetOffsetsArray()))
    indices = to_numpy(polys.GetConnectivityArray())
    strips = data.GetStrips()
    if strips.GetNumberOfCells():
        offsets, connectivity = to_numpy(strips.GetOffsetsArray()), to_numpy(strips.GetConnectivityArray())
        triangles = [_strip(connectivity[a:b]) for a, b in itertools.pairwise(offsets)]
        extra = np.concatenate(triangles)
        counts = np.concatenate([counts, np.full(len(extra), 3)])
        indices = np.concatenate([indices, extra.ravel()])
    if len(counts) == 0:
        raise Refusal(f"holds {data.GetNumberOfPoints()} points but no faces; export the surface itself")
    return counts, indices


def _grid(data: Any, to_numpy: Any) -> tuple[np.ndarray, np.ndarray]:
    cells = data.GetCells()
    types = to_numpy(_cell_types(data)).astype(np.int64)
    offsets, connectivity = to_numpy(cells.GetOffsetsArray()), to_numpy(cells.GetConnectivityArray())
    curved = np.isin(types, _CURVED)
    if curved.any():
        raise Refusal(f"holds curved cells (VTK type {types[curved][0]}); export first-order triangles or quads")
    counts, indices = [], []
    for row in np.flatnonzero(np.isin(types, (_STRIP, _PIXEL))):
        corners = connectivity[offsets[row] : offsets[row + 1]]
        pieces = _strip(corners) if types[row] == _STRIP else corners[None, [0, 1, 3, 2]]
        counts.append(np.full(len(pieces), pieces.shape[1]))
        indices.append(pieces.ravel())
    plain = np.isin(types, (_TRIANGLE, _POLYGON, _QUAD))
    sizes = np.diff(offsets)
    counts.append(sizes[plain])
    indices.append(connectivity[np.repeat(plain, sizes)])
    if sum(map(len, counts)) == 0:
        solid = [_VOLUME_NAMES.get(int(kind), f"cells of VTK type {kind}") for kind in np.unique(types)]
        what = ", ".join(solid) or f"{data.GetNumberOfPoints()} points"
        raise Refusal(f"holds {what} but no surface cells; extract the surface and export that")
    return np.concatenate(counts), np.concatenate(indices)


def _cell_types(grid: Any) -> Any:
    from vtkmodules.vtkCommonCore import vtkVersion

    # GetCellTypesArray is deprecated since 9.6; before it, GetCellTypes lists the distinct types only.
    recent = (vtkVersion.GetVTKMajorVersion(), vtkVersion.GetVTKMinorVersion()) >= (9, 6)
    return grid.GetCellTypes() if recent else grid.GetCellTypesArray()


def _strip(corners: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a strip; every second one is wound the other way in the file."""
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2, ::-1]
    return triangles
