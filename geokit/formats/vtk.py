"""VTK's files: meshes in .vtk, .vtp and .vtu, points with arrays in .vtp. VTK reads in a separate process."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.body import Body

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["content_bytes", "lacks_faces", "read_mesh", "read_points", "write_mesh", "write_points"]

# zlib expands a byte to a thousand at best; real arrays of numbers stay far below this factor.
GROWTH = 100
# VTK's cell types of lines and points, which are left out if there are faces.
_LOWER = (0, 1, 2, 3, 4, 21, 35, 68, 75)
_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = 5, 6, 7, 8, 9
_CURVED = (22, 23, 28, 30, 32, 34, 36, 37, 69, 70, 76, 77)
_VOLUME_NAMES = {10: "tetrahedra", 11: "voxels", 12: "hexahedra", 13: "wedges", 14: "pyramids", 42: "polyhedra"}


@contextmanager
def _reports() -> Iterator[Any]:
    """Collect VTK's messages, which would otherwise only be printed to stderr."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    before, said = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    # The log goes to stderr in addition to the output window.
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkOutputWindow.SetInstance(said)
    try:
        yield said
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(verbosity)


def read_mesh(path: Path) -> list[Body]:
    """Read the triangles, quads, polygons and strips of the file; points, lines and volume cells are left out."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    with _reports() as said:
        data = _data_set(path)
    # VTK reports a damaged file only as text and returns what it has read so far.
    message = " ".join(said.GetOutput().split())
    if "ERR" in message or "Error" in message or data is None:
        raise FileFormatError(
            f"{path}: cannot be read ({message[-300:] or 'no data'}); the file is damaged, export it again"
        )
    if data.GetNumberOfPoints() == 0:
        raise FileFormatError(f"{path}: holds no points; a mesh needs faces, export the surface itself")
    kind = data.GetClassName()
    if kind == "vtkPolyData":
        cells = _poly_data(data, vtk_to_numpy, path)
    elif kind == "vtkUnstructuredGrid":
        cells = _grid(data, vtk_to_numpy, path)
    else:
        raise FileFormatError(f"{path}: holds a {kind}, which is not a surface; extract its surface and export that")
    points = np.ascontiguousarray(vtk_to_numpy(data.GetPoints().GetData()), np.float64)
    counts, indices = (np.ascontiguousarray(values, np.int64) for values in cells)
    return [Body(points, counts, indices)]


def _data_set(path: Path) -> Any:
    from vtkmodules import vtkIOLegacy, vtkIOXML

    reader: Any
    kind = path.suffix.lower()
    if kind == ".vtk":
        reader = vtkIOLegacy.vtkGenericDataObjectReader()
    elif kind == ".vtp":
        reader = vtkIOXML.vtkXMLPolyDataReader()
    else:
        reader = vtkIOXML.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    if reader.GetErrorCode():
        raise FileFormatError(
            f"{path}: cannot be read (VTK's error {reader.GetErrorCode()}); the file is damaged, export it again"
        )
    return reader.GetOutput()


def _poly_data(data: Any, to_numpy: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
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
        raise FileFormatError(
            f"{path}: holds {data.GetNumberOfPoints()} points but no faces; export the surface itself"
        )
    return counts, indices


def _grid(data: Any, to_numpy: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
    cells = data.GetCells()
    types = to_numpy(_cell_types(data)).astype(np.int64)
    offsets, connectivity = to_numpy(cells.GetOffsetsArray()), to_numpy(cells.GetConnectivityArray())
    curved = np.isin(types, _CURVED)
    if curved.any():
        raise FileFormatError(
            f"{path}: holds curved cells (VTK type {types[curved][0]}); export first-order triangles or quads"
        )
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
        raise FileFormatError(f"{path}: holds {what} but no surface cells; extract the surface and export that")
    return np.concatenate(counts), np.concatenate(indices)


def _cell_types(grid: Any) -> Any:
    from vtkmodules.vtkCommonCore import vtkVersion

    # GetCellTypesArray is deprecated since 9.6; before that, GetCellTypes lists only the distinct types.
    recent = (vtkVersion.GetVTKMajorVersion(), vtkVersion.GetVTKMinorVersion()) >= (9, 6)
    return grid.GetCellTypes() if recent else grid.GetCellTypesArray()


def _strip(corners: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a strip; the file winds every second one the other way."""
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2, ::-1]
    return triangles


def write_mesh(
    path: Path, mesh: TriangleMesh, point_data: Mapping[str, NDArray], cell_data: Mapping[str, NDArray]
) -> None:
    """Write poly data, .vtp (compressed) or legacy .vtk (binary), through pyvista, and .vtu through meshio.

    meshio is not used for all of them, because its legacy files name 32-bit integers in a way that VTK cannot read.
    """
    if path.suffix.lower() == ".vtu":
        from geokit.formats import meshio_files

        meshio_files.write_mesh(path, mesh, point_data, cell_data)
        return
    import pyvista

    padded = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces]).ravel()
    surface = pyvista.PolyData(np.array(mesh.vertices), padded)
    for name, values in point_data.items():
        surface.point_data[name] = values
    for name, values in cell_data.items():
        surface.cell_data[name] = values
    surface.save(path)


def lacks_faces(head: bytes) -> bool:
    """Whether the first element of a .vtp declares no polygons and no strips; False if it declares no counts."""
    counts = re.findall(rb"NumberOf(?:Polys|Strips)\s*=\s*\"\s*(\d+)\s*\"", head)
    return bool(counts) and all(int(count) == 0 for count in counts)


def content_bytes(path: Path) -> int:
    """Upper bound of the size of a .vtp file's arrays in bytes.

    Raises:
        FileFormatError: The file is truncated.
    """
    with open(path, "rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 4096, 0))
        # VTK reads a truncated file as a shorter one, without an error.
        if not file.read().rstrip().endswith(b"</VTKFile>"):
            raise FileFormatError(f"{path}: does not end as a VTK file does; it is truncated, get a whole copy")
    return GROWTH * size


def read_points(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Read the points and their arrays.

    Raises:
        FileFormatError: VTK rejects the file.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    with _reports() as said:
        reader.Update()
    message = " ".join(said.GetOutput().split())
    found = reader.GetOutput()
    if reader.GetErrorCode() or "ERR" in message or "Error" in message or found is None:
        raise FileFormatError(f"{path}: VTK cannot read it ({message[-200:] or 'no data'}); export it again")
    if found.GetNumberOfPoints() == 0:
        return np.empty((0, 3)), {}
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    arrays = (found.GetPointData().GetArray(at) for at in range(found.GetPointData().GetNumberOfArrays()))
    # Arrays of strings hold no numbers and are left out.
    return points, {array.GetName() or "unnamed": vtk_to_numpy(array).copy() for array in arrays if array is not None}


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write points as vertex cells, so that viewers show them, with their arrays; binary, float64 kept."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    result = vtkPolyData()
    positions = vtkPoints()
    positions.SetData(numpy_to_vtk(points, deep=True))
    result.SetPoints(positions)
    vertices = vtkCellArray()
    ids = np.arange(len(points) + 1, dtype=np.int64)
    vertices.SetData(numpy_to_vtkIdTypeArray(ids, deep=True), numpy_to_vtkIdTypeArray(ids[:-1], deep=True))
    result.SetVerts(vertices)
    for name, values in data.items():
        plain = values.astype(np.uint8) if values.dtype.kind == "b" else values
        array = numpy_to_vtk(np.ascontiguousarray(plain), deep=True)
        array.SetName(name)
        result.GetPointData().AddArray(array)
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(result)
    with _reports() as said:
        written = writer.Write()
    if not written or writer.GetErrorCode():
        raise OSError(f"VTK: {' '.join(said.GetOutput().split())[-200:] or 'no reason given'}")
