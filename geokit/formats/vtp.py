"""VTK's polygon data (.vtp) as points with arrays, through VTK's own reader and writer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.points_reader_process import read_in_process

__all__ = ["read_here", "read_vtp", "write_vtp"]

# What zlib makes of a byte at best is a thousand; real arrays of numbers stay far below this.
GROWTH = 100


@contextmanager
def _reports() -> Iterator[Any]:
    """Collects what VTK reports, which would otherwise go to stderr and nowhere else."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    before, said = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    # The log goes to stderr beside the window.
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkOutputWindow.SetInstance(said)
    try:
        yield said
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(verbosity)


def read_vtp(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """The points and their arrays, read by VTK in a process of its own.

    Raises:
        FileFormatError: VTK refuses the file, or crashes on it.
    """
    with open(path, "rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 4096, 0))
        # VTK takes a file that ends early for a shorter one.
        if not file.read().rstrip().endswith(b"</VTKFile>"):
            raise FileFormatError(f"{path}: does not end as a VTK file does; it is truncated, get a whole copy")
    return read_in_process(path, "vtp", GROWTH * size)


def read_here(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """As :func:`read_vtp`, in this process.

    Raises:
        FileFormatError: VTK refuses the file.
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
    # Arrays of strings have no numbers and are left out.
    return points, {array.GetName() or "unnamed": vtk_to_numpy(array).copy() for array in arrays if array is not None}


def write_vtp(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Points as vertex cells, so that viewers show them, with their arrays; binary, float64 kept."""
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
