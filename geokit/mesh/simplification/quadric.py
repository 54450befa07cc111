"""Quadric decimation by VTK, in the frame where its float32 positions lose least."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh._model import TriangleMesh

__all__ = ["decimate", "restored"]

# Weight of the quadrics that keep the triangles of flat regions even. Without them, vertices there collect thousands of
# faces, and each collapse examines all of them: ten times as long on the walls of a bracket. A millionth of this part
# of a unit's square moves no vertex visibly in float32; 1e-5 is visible on flat walls (3e-5 of the diagonal).
EVENNESS = 1e-8
# Edge of the cells in which a vertex and a point count as one: some roundings of float32. Corners of flat regions are
# recomputed and come out next to their old position.
SAME_PLACE = 2.0**-21


def decimate(mesh: TriangleMesh, face_count: int) -> TriangleMesh:
    """Collapse the edges of least cost until no more than ``face_count`` faces are left, or VTK finds no more edges.

    Args:
        mesh: About unit-sized and near the origin; one vertex for each position.
        face_count: Wanted number of faces.
    Returns:
        TriangleMesh without unused vertices. Vertices that were not moved have their float64 positions, others are
        exact to 5e-7 of a unit.
    Source:
        Garland and Heckbert, "Surface simplification using quadric error metrics" (1997), as in vtkQuadricDecimation:
        boundary edges have planes of their own, and a collapse that would flip a face is not done.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

    filtered = vtkQuadricDecimation()
    filtered.SetInputData(_poly_data(mesh))
    # Half a face more than wanted: the filter stops at the first count that is no larger.
    filtered.SetTargetReduction(max(0.0, 1.0 - (face_count + 0.5) / len(mesh.faces)))
    # VTK before 9.4 lacks this option, and takes longer.
    if hasattr(filtered, "SetRegularization"):
        filtered.RegularizeOn()
        filtered.SetRegularization(EVENNESS)
    filtered.Update()
    data: Any = filtered.GetOutput()
    faces = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int32)
    points = vtk_to_numpy(data.GetPoints().GetData()) if len(faces) else np.empty((0, 3), np.float32)
    used, corner = np.unique(faces, return_inverse=True)
    return TriangleMesh(_placed(points[used], mesh.vertices), corner.reshape(-1, 3).astype(np.int32))


def _poly_data(mesh: TriangleMesh) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(mesh.vertices, deep=True))
    offsets = np.arange(0, 3 * len(mesh.faces) + 1, 3, dtype=np.int64)
    corners = mesh.faces.reshape(-1).astype(np.int64)
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(corners, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data


def restored(
    points: NDArray[Any],
    before: NDArray[Any],
    exact: NDArray[np.float64],
    otherwise: Callable[[NDArray[Any]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """For each point that equals a row of ``before`` the row of ``exact``, for the others ``otherwise`` of the
    point."""
    # Adding zero turns -0.0 into 0.0, which is the same position in other bytes.
    rows = [np.ascontiguousarray(array) + array.dtype.type(0.0) for array in (before, points)]
    keys, wanted = (array.view(np.dtype((np.void, 3 * array.itemsize))).reshape(-1) for array in rows)
    order = np.argsort(keys, kind="stable")
    place = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
    nearest = order[place]
    same = keys[nearest] == wanted
    return np.where(same[:, None], exact[nearest], otherwise(points))


def _placed(points: NDArray[np.float32], vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points in float64; a point that was not moved, or returned to a vertex, gets that vertex's position."""
    near = restored(
        np.round(points.astype(np.float64) / SAME_PLACE),
        np.round(vertices / SAME_PLACE),
        vertices,
        lambda _: points.astype(np.float64),
    )
    return restored(points, vertices.astype(points.dtype), vertices, lambda _: near)
