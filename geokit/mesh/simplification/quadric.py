"""Quadric decimation by VTK, in the frame where its float32 positions lose least."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.mesh._model import TriangleMesh

__all__ = ["decimate", "restored"]

# Weight of the quadrics that keep the triangles of flat regions even. Without, vertices there collect thousands of
# faces, and each collapse looks at all of them: ten times as long on the walls of a bracket. A millionth of this part
# of a unit's square moves no vertex by what float32 would show; 1e-5 is seen on flat walls (3e-5 of the diagonal).
EVENNESS = 1e-8
# Edge of the cells in which a vertex and a point are taken for the same place: some roundings of float32. Corners of
# flat regions are computed anew and come out next to where they were.
SAME_PLACE = 2.0**-21


def decimate(mesh: TriangleMesh, face_count: int) -> TriangleMesh:
    """The mesh after collapsing the edges that cost least, until no more faces are left than asked for, where VTK can.

    Args:
        mesh: About as large as a unit and next to the origin; each position has one vertex.
        face_count: Wanted number of faces.
    Returns:
        TriangleMesh without unused vertices. Vertices that were not moved have their float64 positions, others are
        good to 5e-7 of a unit.
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
    # VTK before 9.4 does without, and takes longer.
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
    """The rows of ``exact`` for points that equal a row of ``before``, and ``otherwise`` of the points for others."""
    # Plus zero: -0.0 and 0.0 are the same place in other bytes.
    rows = [np.ascontiguousarray(array) + array.dtype.type(0.0) for array in (before, points)]
    keys, wanted = (array.view(np.dtype((np.void, 3 * array.itemsize))).reshape(-1) for array in rows)
    order = np.argsort(keys, kind="stable")
    place = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
    nearest = order[place]
    same = keys[nearest] == wanted
    return np.where(same[:, None], exact[nearest], otherwise(points))


def _placed(points: NDArray[np.float32], vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points in float64: the vertex for those that were not moved, or came back to one."""
    near = restored(
        np.round(points.astype(np.float64) / SAME_PLACE),
        np.round(vertices / SAME_PLACE),
        vertices,
        lambda _: points.astype(np.float64),
    )
    return restored(points, vertices.astype(points.dtype), vertices, lambda _: near)
