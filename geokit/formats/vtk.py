"""VTK's files: meshes in .vtk, .vtp and .vtu, points with arrays in .vtp. VTK reads in a separate process."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit._warn import warn
from geokit.core.base.forks import Lock
from geokit.core.files import damaged
from geokit.errors import FileFormatError
from geokit.formats.attributes.columns import xml_name
from geokit.formats.file_content.body import Body
from geokit.mesh.model.data import has_meaning

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Names of the arrays that say what the numbers mean.
_METERS, _UP = "meters_per_unit", "up_axis"
# VTK's cell types. Lines and points are left out if there are faces.
_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = 5, 6, 7, 8, 9
_CURVED = (22, 23, 28, 30, 32, 34, 36, 37, 69, 70, 76, 77)
# VTK's writers note the largest norm of arrays with several numbers a row, and its readers refuse it as nan or inf. No
# value depends on it.
_REFUSED_NORM = re.compile(
    r"ERROR: In \S+, line \d+\s+vtk\w+ \S+ Error reading InformationKey element for vtkDataArray::\S+ of type \S+"
)
_NORMS = re.compile(rb'\s*<InformationKey name="L2_NORM_RANGE".*?</InformationKey>', re.DOTALL)
# Arrays of legacy files as meshio declares their types, and VTK's names of these.
_NAMED_BY_SIZE = re.compile(rb"^(\S{1,300} \d+ \d+ )vtktype(u?int(?:8|16|32))\r?$", re.MULTILINE)
_NAMES = {
    b"int8": b"signed_char", b"int16": b"short", b"int32": b"int",
    b"uint8": b"unsigned_char", b"uint16": b"unsigned_short", b"uint32": b"unsigned_int",
}  # fmt: skip
_VOLUME_NAMES = {10: "tetrahedra", 11: "voxels", 12: "hexahedra", 13: "wedges", 14: "pyramids", 42: "polyhedra"}
_LINE_NAMES = {1: "points", 2: "points", 3: "lines", 4: "lines"}


# VTK has one output window for all threads.
_window = Lock()


@contextmanager
def _collected() -> Iterator[Any]:
    """Collect VTK's messages, which would otherwise only be printed to stderr; the window's lock is taken before."""
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


def prepare() -> None:
    """Import the readers and load their libraries."""
    from vtkmodules.util import numpy_support  # noqa: F401
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    vtkXMLPolyDataReader(), vtkGenericDataObjectReader()


def read_mesh(path: Path) -> list[Body]:
    """Read the triangles, quads, polygons and strips; points, lines and volume cells are left out, with a note.

    Arrays of points and cells come along. Those that VTK marks as normals and texture coordinates are called so.
    """
    vtk_to_numpy = require_package("vtkmodules.util.numpy_support").vtk_to_numpy
    with _window, _collected() as said:
        data = _data_set(path)
    # VTK reports a damaged file only as text and returns what it has read so far.
    message = reported(said)
    if "ERR" in message or "Error" in message or data is None:
        raise damaged(path, f"cannot be read ({_without_pointers(message) or 'no data'})")
    if message:
        warn(_without_pointers(message))
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
    counts, indices, rows = (np.ascontiguousarray(values, np.int64) for values in cells)
    polygon = {name: values[rows] for name, values in _arrays(data.GetCellData(), vtk_to_numpy).items()}
    listed = ", ".join(f"{name} ({count})" for name, count in _others(data, vtk_to_numpy).items())
    vertex = _arrays(data.GetPointData(), vtk_to_numpy)
    unit = unit_of(data.GetFieldData())
    held = (data.GetPointData(), data.GetCellData(), data.GetFieldData())
    notes = (*([f"its {listed} are left out"] if listed else []), *(text for one in held for text in no_numbers(one)))
    return [Body(points, counts, indices, vertex_data=vertex, polygon_data=polygon, notes=notes, **unit)]


def unit_of(fields: Any) -> dict[str, Any]:
    """The unit and the axis that is up, as :func:`poly_data` writes them; what else is called so is passed over."""
    found: dict[str, Any] = {}
    meters, axis = fields.GetArray(_METERS), fields.GetAbstractArray(_UP)
    if meters is not None and meters.GetNumberOfValues() == 1 and 0.0 < meters.GetTuple1(0) < float("inf"):
        found["meters_per_unit"] = meters.GetTuple1(0)
    is_text = axis is not None and axis.GetClassName() == "vtkStringArray" and axis.GetNumberOfValues() == 1
    if is_text and axis.GetValue(0) in ("x", "y", "z"):
        found["up_axis"] = axis.GetValue(0)
    return found


def no_numbers(data: Any) -> list[str]:
    """What is left out of arrays of points, cells or the file: those that hold no numbers; a note if there are any."""
    every = [(data.GetArray(at), data.GetAbstractArray(at)) for at in range(data.GetNumberOfArrays())]
    names = [array.GetName() or "unnamed" for numbers, array in every if numbers is None and array is not None]
    listed = ", ".join(repr(name) for name in names if name != _UP)
    return [f"its arrays that hold no numbers are left out: {listed}"] if listed else []


def _arrays(data: Any, to_numpy: Any) -> dict[str, NDArray[Any]]:
    """Arrays by name; those of strings are left out."""
    active = {"normal": data.GetNormals(), "uv": data.GetTCoords()}
    names = {array.GetName(): name for name, array in active.items() if array and not data.GetArray(name)}
    found = {}
    for at in range(data.GetNumberOfArrays()):
        array = data.GetArray(at)
        if array is not None:
            name = names.get(array.GetName(), array.GetName() or "unnamed")
            values = to_numpy(array)
            # Texture coordinates of volumes have a third number.
            found[name] = values[:, :2] if name == "uv" and values.ndim == 2 else values
    return found


def reported(said: Any) -> str:
    """What VTK reported, on one line; "" if nothing concerns the content of the file."""
    return " ".join(_REFUSED_NORM.sub("", said.GetOutput()).split())


def _without_pointers(message: str) -> str:
    """What VTK says first, without places in its sources and addresses in memory."""
    message = re.sub(r"\b(ERROR|Warning): In \S+, line \d+\s*|\s*\(0x[0-9a-fA-F]+\)", "", message)
    message = message.split(" vtkCompositeDataPipeline:")[0].strip()
    # Readers that call each other say the same.
    return " ".join(dict.fromkeys(re.sub(r"^vtk\w+: ", "", part) for part in re.split(r"\s(?=vtk\w+: )", message)))[
        :300
    ]


def _data_set(path: Path) -> Any:
    from vtkmodules import vtkIOLegacy, vtkIOXML
    from vtkmodules.vtkCommonMisc import vtkErrorCode

    reader: Any
    kind = path.suffix.lower()
    if kind == ".vtk":
        reader = vtkIOLegacy.vtkGenericDataObjectReader()
        content = path.read_bytes()
        if _NAMED_BY_SIZE.search(content):
            content = _NAMED_BY_SIZE.sub(lambda found: found[1] + _NAMES[found[2]], content)
            reader.ReadFromInputStringOn()
            reader.SetBinaryInputString(content, len(content))
    elif kind == ".vtp":
        reader = vtkIOXML.vtkXMLPolyDataReader()
    else:
        reader = vtkIOXML.vtkXMLUnstructuredGridReader()
    reader.SetFileName(os.fsencode(path))
    reader.Update()
    if reader.GetErrorCode():
        reason = vtkErrorCode.GetStringFromErrorCode(reader.GetErrorCode())
        raise damaged(path, f"cannot be read (VTK: {reason})")
    return reader.GetOutput()


def _poly_data(data: Any, to_numpy: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corner counts, indices, and the row of each polygon in the data of cells: vertices and lines come before."""
    polys = data.GetPolys()
    first = data.GetVerts().GetNumberOfCells() + data.GetLines().GetNumberOfCells()
    rows = first + np.arange(polys.GetNumberOfCells())
    counts = np.diff(to_numpy(polys.GetOffsetsArray()))
    indices = to_numpy(polys.GetConnectivityArray())
    strips = data.GetStrips()
    if strips.GetNumberOfCells():
        offsets, connectivity = to_numpy(strips.GetOffsetsArray()), to_numpy(strips.GetConnectivityArray())
        triangles = [_strip(connectivity[a:b]) for a, b in itertools.pairwise(offsets)]
        extra = np.concatenate(triangles)
        counts = np.concatenate([counts, np.full(len(extra), 3)])
        indices = np.concatenate([indices, extra.ravel()])
        rows = np.append(rows, first + len(rows) + np.repeat(np.arange(len(triangles)), list(map(len, triangles))))
    if len(counts) == 0:
        raise FileFormatError(
            f"{path}: holds {data.GetNumberOfPoints()} points but no faces; export the surface itself"
        )
    return counts, indices, rows


def _others(data: Any, to_numpy: Any) -> dict[str, int]:
    """What is left out by its name: cells that are no faces."""
    if data.GetClassName() == "vtkPolyData":
        counts = {"points": data.GetVerts().GetNumberOfCells(), "lines": data.GetLines().GetNumberOfCells()}
        return {name: count for name, count in counts.items() if count}
    found: dict[str, int] = {}
    kinds, numbers = np.unique(to_numpy(_cell_types(data)), return_counts=True)
    for kind, count in zip(kinds.tolist(), numbers.tolist(), strict=True):
        if kind not in (0, _TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD):
            name = _VOLUME_NAMES.get(kind) or _LINE_NAMES.get(kind, f"cells of VTK type {kind}")
            found[name] = found.get(name, 0) + count
    return found


def _grid(data: Any, to_numpy: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = data.GetCells()
    types = to_numpy(_cell_types(data)).astype(np.int64)
    offsets, connectivity = to_numpy(cells.GetOffsetsArray()), to_numpy(cells.GetConnectivityArray())
    curved = np.isin(types, _CURVED)
    if curved.any():
        raise FileFormatError(
            f"{path}: holds curved cells (VTK type {types[curved][0]}); export first-order triangles or quads"
        )
    counts, indices, rows = [], [], []
    for row in np.flatnonzero(np.isin(types, (_STRIP, _PIXEL))):
        corners = connectivity[offsets[row] : offsets[row + 1]]
        pieces = _strip(corners) if types[row] == _STRIP else corners[None, [0, 1, 3, 2]]
        counts.append(np.full(len(pieces), pieces.shape[1]))
        indices.append(pieces.ravel())
        rows.append(np.full(len(pieces), row))
    plain = np.isin(types, (_TRIANGLE, _POLYGON, _QUAD))
    sizes = np.diff(offsets)
    counts.append(sizes[plain])
    indices.append(connectivity[np.repeat(plain, sizes)])
    rows.append(np.flatnonzero(plain))
    if sum(map(len, counts)) == 0:
        solid = [_VOLUME_NAMES.get(int(kind), f"cells of VTK type {kind}") for kind in np.unique(types)]
        what = ", ".join(solid) or f"{data.GetNumberOfPoints()} points"
        raise FileFormatError(f"{path}: holds {what} but no surface cells; extract the surface and export that")
    return np.concatenate(counts), np.concatenate(indices), np.concatenate(rows)


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


def holds_name(name: str, kind: str) -> bool:
    """Whether an array's name can be written. VTK ends the process where one in a .vtk has braces."""
    return kind != ".vtk" or (name.isprintable() and not {*name} & {*"{}"})


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write poly data, .vtp (compressed) or legacy .vtk (binary), by VTK, and .vtu through meshio.

    meshio is not used for all of them, because its legacy files name 32-bit integers in a way that VTK cannot read.
    """
    if path.suffix.lower() == ".vtu":
        from geokit.formats import meshio_files

        meshio_files.write_mesh(path, mesh)
        return
    surface = poly_data(mesh)
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    is_legacy = path.suffix.lower() == ".vtk"
    writer: Any = vtkPolyDataWriter() if is_legacy else vtkXMLPolyDataWriter()
    (writer.SetFileTypeToBinary if is_legacy else writer.SetDataModeToBinary)()
    _write(writer, surface, path)


def poly_data(mesh: TriangleMesh) -> Any:
    """A ``pyvista.PolyData`` with the arrays of vertices and faces; normals and texture coordinates are marked."""
    pyvista = require_package("pyvista")
    padded = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces]).ravel()
    surface = pyvista.PolyData(np.array(mesh.vertices), padded)
    for into, data in ((surface.point_data, mesh.vertex_data), (surface.cell_data, mesh.face_data)):
        for name, values in data.items():
            # VTK ends a name there.
            into[name.replace("\0", "_")] = np.array(values, np.float32 if values.dtype == np.float16 else values.dtype)
        for name, mark in (("normal", "active_normals_name"), ("uv", "active_texture_coordinates_name")):
            if name in data and has_meaning(name, data[name]):
                setattr(into, mark, name)
    if mesh.meters_per_unit is not None:
        surface.field_data[_METERS] = [mesh.meters_per_unit]
    if mesh.up_axis is not None:
        surface.field_data[_UP] = [mesh.up_axis]
    return surface


def _write(writer: Any, data: Any, path: Path) -> None:
    """Write through memory: on a full disk, VTK's own file writing ends the process, or reports no error.

    Arrays of what becomes XML get names that can stand there.
    """
    is_xml = hasattr(writer, "SetDataModeToBinary")
    for attributes in (data.GetPointData(), data.GetCellData()) if is_xml else ():
        for at in range(attributes.GetNumberOfArrays()):
            array = attributes.GetAbstractArray(at)
            array.SetName(xml_name(array.GetName()))
    if is_xml:
        # Less than half the time of VTK's usual 5, for files of the same size within 3 %.
        writer.SetCompressionLevel(4)
    writer.SetInputData(data)
    writer.SetWriteToOutputString(True)
    with _window, _collected() as said:
        written = writer.Write()
    if not written or writer.GetErrorCode():
        raise OSError(f"VTK: {' '.join(said.GetOutput().split())[-200:] or 'no reason given'}")
    # The two writers call it differently, and it is text or bytes, depending on its content.
    whole = writer.GetOutputStdString() if hasattr(writer, "GetOutputStdString") else writer.GetOutputString()
    content = whole if isinstance(whole, bytes) else whole.encode()
    path.write_bytes(_NORMS.sub(b"", content) if is_xml else content)


def lacks_faces(head: bytes) -> bool:
    """Whether the first element of a .vtp declares no polygons and no strips; False if it declares no counts."""
    counts = re.findall(rb"NumberOf(?:Polys|Strips)\s*=\s*\"\s*(\d+)\s*\"", head)
    return bool(counts) and all(int(count) == 0 for count in counts)


def read_points(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Read the points and their arrays.

    Raises:
        FileFormatError: The file is truncated, or VTK rejects it.
    """
    require_package("vtkmodules")
    with open(path, "rb") as file:
        file.seek(max(file.seek(0, 2) - 4096, 0))
        # VTK reads a truncated file as a shorter one, without an error.
        if not file.read().rstrip().endswith(b"</VTKFile>"):
            raise FileFormatError(f"{path}: does not end as a VTK file does; it is truncated, get a whole copy")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    name: Any = os.fsencode(path)  # VTK's stubs know text only
    reader.SetFileName(name)
    with _window, _collected() as said:
        reader.Update()
    message = reported(said)
    found = reader.GetOutput()
    if reader.GetErrorCode() or "ERR" in message or "Error" in message or found is None:
        raise FileFormatError(
            f"{path}: VTK cannot read it ({_without_pointers(message) or 'no data'}); export it again"
        )
    if found.GetNumberOfPoints() == 0:
        return np.empty((0, 3)), {}
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    for text in no_numbers(found.GetPointData()):
        warn(text)
    arrays = (found.GetPointData().GetArray(at) for at in range(found.GetPointData().GetNumberOfArrays()))
    return points, {array.GetName() or "unnamed": vtk_to_numpy(array).copy() for array in arrays if array is not None}


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write points as vertex cells, so that viewers show them, with their arrays; binary, float64 kept."""
    require_package("vtkmodules.vtkIOXML")
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
        changed = {"?": np.uint8, "e": np.float32}.get(values.dtype.char)
        plain = values if changed is None else values.astype(changed)
        array = numpy_to_vtk(np.ascontiguousarray(plain), deep=True)
        array.SetName(name.replace("\0", "_"))
        result.GetPointData().AddArray(array)
    _write(vtkXMLPolyDataWriter(), result, path)
