"""Fluent .msh and .xdmf through meshio, which reads in a separate process; also writes .vtu and .msh."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.attributes.columns import as_columns, from_columns, xml_name
from geokit.formats.body import Body
from geokit.formats.exchange.gmsh import is_gmsh, read_gmsh
from geokit.formats.references import LONGEST, require_inside
from geokit.mesh._data import full_scale, has_meaning

if TYPE_CHECKING:
    from geokit.mesh._data import Data
    from geokit.mesh._model import TriangleMesh

__all__ = ["holds_type", "named", "prepare", "read_mesh", "write_mesh"]

_SURFACE = {"triangle", "quad", "polygon"}
# meshio's dimensions of second-order cells are right, but the cells themselves are not polygons.
_LESS = ("points", "lines")
# Numbers that a row may have; .vtu takes any.
_WIDTHS = {".msh": (1, 3, 9), ".xdmf": (1, 2, 3, 6, 9)}
# Beyond these a float64, the only type of .msh, does not hold each integer.
LARGEST_EXACT = 1 << 53
# Soft links of HDF5 that lead to each other.
LONGEST_CHAIN = 16


def prepare() -> None:
    """Import meshio, and h5py where it is installed."""
    import meshio  # noqa: F401

    with contextlib.suppress(ImportError):
        import h5py  # noqa: F401


def read_mesh(path: Path, folders: Sequence[Path], step: int | None = None) -> list[Body]:
    """Read the triangles, quads and polygons of the file; points, lines and volume cells are left out, with a note.

    Arrays of points and cells come along, and the physical groups of .msh as ``physical``. Arrays of an .xdmf in other
    files are read from the file's own folder and from ``folders``. ``step`` is the number of one grid of a time series.
    """
    if path.suffix.lower() == ".msh" and is_gmsh(path):
        return read_gmsh(path)
    meshio = require_package("meshio")
    notes: list[str] = []
    first = 0
    # Not meshio.read, which prints the reason and exits.
    if path.suffix.lower() == ".xdmf":
        root = _one_grid(path, step)
        first, said = _numbering(path, root)
        notes += said
        _check_arrays(path, folders)
        mesh = _xdmf_reader()(path).read_root(root)
    else:
        mesh = meshio.ansys.read(path)
    counts: list[np.ndarray] = []
    indices: list[np.ndarray] = []
    volume: dict[str, int] = {}
    less = dict.fromkeys(_LESS, 0)
    blocks = []
    for number, block in enumerate(mesh.cells):
        if block.type in _SURFACE:
            blocks.append(number)
            rows = [np.asarray(row, np.int64) for row in block.data] if block.type == "polygon" else block.data
            counts.append(np.fromiter(map(len, rows), np.int64, len(rows)))
            indices.append(np.concatenate(rows) if len(rows) else np.zeros(0, np.int64))
        elif block.dim == 2:
            raise FileFormatError(
                f"{path}: holds '{block.type}' cells, which are not polygons; export first-order triangles or quads"
            )
        elif block.dim < len(_LESS):
            less[_LESS[block.dim]] += len(block.data)
        else:
            volume[block.type] = volume.get(block.type, 0) + len(block.data)
    if not counts:
        what = ", ".join(f"{count} {kind}" for kind, count in volume.items()) or f"{len(mesh.points)} points"
        raise FileFormatError(f"{path}: holds {what} but no surface cells; extract the surface and export that")
    points = np.asarray(mesh.points, np.float64)
    if points.shape[1] == 2:
        points = np.pad(points, ((0, 0), (0, 1)))
    cells = {name: np.concatenate([values[at] for at in blocks]) for name, values in mesh.cell_data.items()}
    vertex, polygon = (named(data) for data in (mesh.point_data, cells))
    faces = np.concatenate(counts), np.concatenate(indices).astype(np.int64) - first
    listed = ", ".join(f"{count} {kind}" for kind, count in volume.items())
    notes += [f"its volume cells ({listed}) are left out"] if listed else []
    notes += [f"its {name} ({count}) are left out" for name, count in less.items() if count]
    return [Body(points, *faces, vertex_data=vertex, polygon_data=polygon, notes=tuple(notes))]


def named(data: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Numbers of the file by name, without those that gmsh keeps of its own."""
    plain = {"physical" if name == "gmsh:physical" else name: values for name, values in data.items()}
    return from_columns(
        {
            name: values[:, 0] if values.shape[1:] == (1,) else values
            for name, values in plain.items()
            if not name.startswith("gmsh:") and values.dtype.kind in "fiub"
        }
    )


# Grid[@Name="mesh"], Grid[1], Grid.
_POINTED = re.compile(r"""Grid(?:\[@Name=["']([^"']*)["']\])?(?:\[(\d+)\])?""")


def _xdmf_reader() -> Any:
    from meshio.xdmf.common import xdmf_to_numpy_type
    from meshio.xdmf.main import XdmfReader

    class Reader(XdmfReader):
        """Opens files of plain numbers relative to the file, where meshio does to the working folder."""

        def _read_data_item(self, item: Any, root: Any = None) -> Any:
            if (kind := item.get("ItemType", "Uniform")).lower() != "uniform":
                raise FileFormatError(
                    f"{self.filename}: has an array of the type {kind[:40]}, which is not read; save plain arrays"
                )
            if item.get("Format") == "Binary":
                return self._binary(item)
            return super()._read_data_item(item, root)

        def _binary(self, item: Any) -> Any:
            """Numbers in the file's order of bytes from a place on, both of which meshio passes over."""
            kind = (item.get("DataType", item.get("NumberType", "Float")), item.get("Precision", "4"))
            order = {"big": ">", "little": "<", "native": "="}.get(item.get("Endian", "native").lower())
            if order is None or item.get("Compression", "Raw").lower() != "raw":
                raise FileFormatError(
                    f"{self.filename}: has binary numbers that are compressed or in an order of bytes that is not "
                    "known; save them plainly, or in HDF5"
                )
            shape = [int(number) for number in item.get("Dimensions").split()]
            dtype = np.dtype(xdmf_to_numpy_type[kind]).newbyteorder(order)
            at, name = int(item.get("Seek", "0")), self.filename.parent / (item.text or "").strip()
            found = np.fromfile(name, dtype, math.prod(shape), offset=at).reshape(shape)
            return found.astype(dtype.newbyteorder("="))

        def read_root(self, root: Any) -> Any:
            """What ``read`` makes of a file with this content."""
            if root.tag != "Xdmf":
                raise FileFormatError(f"{self.filename}: its outermost element is {root.tag[:40]}, not Xdmf")
            version = root.get("Version", "3")
            if version.split(".")[0] not in ("2", "3"):
                raise FileFormatError(f"{self.filename}: is of version {version[:20]} of XDMF; export version 2 or 3")
            try:
                return (self.read_xdmf2 if version.startswith("2") else self.read_xdmf3)(root)
            except KeyError as error:
                kinds = [item.get("TopologyType", item.get("Type")) for item in root.iter("Topology")]
                kind = error.args[0]
                if kind not in kinds and not isinstance(kind, np.integer):
                    raise
                told = "polygons" if kind in ("Polygon", 3) else f"cells of the type {str(kind)[:40]}"
                raise FileFormatError(
                    f"{self.filename}: has {told}, which are not read; export triangles or quads"
                ) from None

    return Reader


def _one_grid(path: Path, step: int | None) -> Any:
    """The content of an .xdmf with one grid, which is what meshio reads; of a time series that of a step.

    Raises:
        FileFormatError: It holds a series of times and no step is given, or not that one; several grids; or a geometry
            of separate arrays for each axis.
    """
    from xml.etree import ElementTree

    root = ElementTree.parse(path).getroot()
    domain = next((item for item in root.iter() if item.tag == "Domain"), None)
    series = [] if domain is None else [grid for grid in domain.findall("Grid") if _is_series(grid)]
    if step is not None and domain is not None:
        if len(series) != 1:
            raise FileFormatError(f"{path}: holds {len(series)} time series, and step= chooses from one; leave it out")
        chosen = _step_of(path, root, series[0], step)
        # Other grids of the domain are what the steps refer to.
        for grid in domain.findall("Grid"):
            domain.remove(grid)
        domain.append(chosen)
    grids = [] if domain is None else domain.findall("Grid")
    for grid in grids:
        kind = grid.get("GridType", "Uniform").lower()
        steps = len(grid.findall("Grid")) or len(grid.findall("{*}include"))
        if _is_series(grid):
            raise FileFormatError(
                f"{path}: holds a time series of {steps} {'step' if steps == 1 else 'steps'}; choose one with step=0 "
                f"to step={max(steps - 1, 0)}"
            )
        if kind in ("collection", "tree"):
            raise FileFormatError(
                f"{path}: holds a collection of {steps} grids, and geokit reads one; save each as a file of its own, "
                "or join them first"
            )
        for time in grid.findall("Time"):
            grid.remove(time)  # meshio knows no such element
        geometry = grid.find("Geometry")
        told = "" if geometry is None else geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper()
        if told not in ("", "XYZ", "XY"):
            raise FileFormatError(
                f"{path}: has geometry of type {told[:40]}, which geokit does not read; export a surface of triangles "
                "with XYZ points"
            )
    if len(grids) > 1:
        raise FileFormatError(
            f"{path}: holds {len(grids)} grids, and geokit reads one; save each as a file of its own, or join them "
            "first"
        )
    return root


def _numbering(path: Path, root: Any) -> tuple[int, list[str]]:
    """The number of the first vertex, and notes on arrays that are left out; meshio knows neither.

    Raises:
        FileFormatError: The corners of cells are in another order.
    """
    topology = next(root.iter("Topology"), None)
    order = [] if topology is None else topology.get("Order", "").split()
    if order != [str(at) for at in range(len(order))]:
        raise FileFormatError(
            f"{path}: has the corners of its cells in the order {' '.join(order)[:40]}; export it plainly"
        )
    lost = []
    for grid in list(root.iter("Grid")):
        for array in grid.findall("Attribute"):
            if (center := array.get("Center", "Node")) not in ("Node", "Cell"):
                grid.remove(array)
                lost.append(f"the array {array.get('Name', '')[:100]!r} is left out: it is of center {center[:40]!r}")
    first = "0" if topology is None else topology.get("BaseOffset", "0")
    return int(first), lost


def _is_series(grid: Any) -> bool:
    kind = grid.get("GridType", "Uniform").lower()
    return kind == "collection" and grid.get("CollectionType", "").lower() == "temporal"


def _step_of(path: Path, root: Any, series: Any, step: int) -> Any:
    """A grid of a time series, with the topology and the geometry that it refers to.

    Raises:
        FileFormatError: There is none of this number, or it refers to what is not there.
    """
    grids = series.findall("Grid")
    if not -len(grids) <= step < len(grids):
        raise FileFormatError(
            f"{path}: has no step {step}; its time series has {len(grids)}; choose one with step=0 "
            f"to step={max(len(grids) - 1, 0)}"
        )
    grid = grids[step]
    for include in grid.findall("{*}include"):
        pointer = include.get("xpointer", "")
        found = _pointed_at(root, pointer) if not include.get("href") else None
        # Steps that keep their mesh refer to that of a grid beside the series, or of its first step.
        if found is not None and _is_series(found):
            found = found.find("Grid")
        parts = [] if found is None else [found.find(tag) for tag in ("Topology", "Geometry") if tag in pointer]
        if not parts or any(part is None for part in parts):
            raise FileFormatError(
                f"{path}: step {step} refers to {pointer[:100]!r}, which is not there; export it again"
            )
        grid.remove(include)
        grid.extend(part for part in parts if grid.find(part.tag) is None)
    return grid


def _pointed_at(root: Any, pointer: str) -> Any:
    """The grid that a pointer of XInclude names: by the names and numbers of grids from outside to inside."""
    found = root
    for name, number in _POINTED.findall(pointer):
        below = [grid for grid in (found.iter("Grid") if found is root else found.findall("Grid")) if grid is not found]
        if name:
            below = [grid for grid in below if grid.get("Name") == name]
        at = int(number or 1) - 1
        if at >= len(below):
            return None
        found = below[at]
    return None if found is root else found


def _check_arrays(path: Path, folders: Sequence[Path]) -> None:
    """Check every file that the items of an .xdmf name, before meshio opens it."""
    from xml.etree import ElementTree

    for item in ElementTree.parse(path).iter():
        # meshio also follows references to items of other tags.
        kind, text = item.get("Format", "XML"), (item.text or "").strip()
        if kind == "XML" or "Reference" in item.attrib:
            continue
        name, _, inner = text.partition(":") if kind == "HDF" else (text, "", "")
        found = require_inside(name, path.parent / name, path, folders)
        if not os.path.exists(found):
            raise FileFormatError(f"{path}: refers to {name[:LONGEST]!r}, which is missing; get it too")
        if kind == "HDF":
            _check_hdf5(found, inner, path)


def _check_hdf5(found: Path, inner: str, path: Path) -> None:
    """Check that an array lies in its HDF5 file, which can link to other files and keep arrays there."""
    h5py = require_package("h5py")

    def follow(group: Any, name: str, depth: int) -> Any:
        if depth > LONGEST_CHAIN:
            raise FileFormatError(f"{found}: {inner!r} is a circle of links; the file is damaged")
        for key in filter(None, name.split("/")):
            link = group.get(key, getlink=True)
            if isinstance(link, h5py.SoftLink):
                group = follow(group.file if link.path.startswith("/") else group, link.path, depth + 1)
            elif isinstance(link, h5py.HardLink):
                group = group[key]
            else:
                raise FileAccessError(f"{path}: {name!r} in {found.name} lies in another file; {remedy}")
        return group

    remedy = "copy its arrays into one file"
    with h5py.File(found, "r") as file:
        array = follow(file, inner, 0)
        if isinstance(array, h5py.Dataset) and (array.external or array.is_virtual):
            raise FileAccessError(
                f"{path}: the array {inner!r} of {found.name} keeps its values in another file; {remedy}"
            )


def holds_type(values: NDArray[Any], kind: str) -> bool:
    """Whether the format holds the numbers exactly; float64 is the only type of .msh."""
    if kind != ".msh" or values.dtype.kind not in "iu" or not values.size:
        return True
    return bool(values.min() >= -LARGEST_EXACT and values.max() <= LARGEST_EXACT)


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write VTK .vtu, Gmsh .msh 4.1 (both binary), and .xdmf in one file, through meshio."""
    meshio = require_package("meshio")
    kind = path.suffix.lower()
    vertex, face = (_named(_split(_scaled(data, kind), kind), kind) for data in (mesh.vertex_data, mesh.face_data))
    content = meshio.Mesh(
        np.array(mesh.vertices),
        [("triangle", np.array(mesh.faces))],
        point_data=vertex,
        cell_data={name: [values] for name, values in face.items()},
    )
    # Inline, because a second file for the arrays could not be replaced atomically together with the first.
    write = functools.partial(_xdmf_writer(), data_format="XML")
    if kind != ".xdmf":
        write = functools.partial(meshio.write, file_format={".vtu": "vtu", ".msh": "gmsh"}[kind])
    # meshio prints advice to standard output and warns about its own choices, so both are suppressed.
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write(path, content)


def _xdmf_writer() -> Any:
    from meshio.xdmf.main import XdmfWriter

    class Writer(XdmfWriter):
        """Writes float32 with all its digits, of which meshio leaves one out."""

        def numpy_to_xml_string(self, data: Any) -> Any:
            return super().numpy_to_xml_string(data.astype(np.float64) if data.dtype == np.float32 else data)

    return Writer


def _named(data: Data, kind: str) -> dict[str, NDArray[Any]]:
    """Arrays as the format has them, with names that meshio's readers find again."""
    found: dict[str, NDArray[Any]] = {}
    for given, values in data.items():
        name = "".join(sign if sign.isprintable() and (sign != '"' or kind == ".vtu") else "_" for sign in given)
        while (label := xml_name(name) if kind == ".vtu" else name) in found:
            name += "_"
        found[label] = _storable(np.array(values), kind)
    return found


def _scaled(data: Data, kind: str) -> Data:
    """Colors from 0 to 1 where the format changes the type that says what is full."""
    colors = data.get("color")
    if kind == ".vtu" or colors is None or colors.dtype.kind == "f" or not has_meaning("color", colors):
        return data
    return {**data, "color": colors / full_scale(colors.dtype)}


def _split(data: Data, kind: str) -> Data:
    """The arrays, with columns in place of those whose rows the format does not have."""
    widths = _WIDTHS.get(kind)
    if widths is None:
        return data
    whole = {name: values for name, values in data.items() if values.ndim == 1 or values.shape[1] in widths}
    return {**whole, **as_columns({name: values for name, values in data.items() if name not in whole}, (*whole,))}


def _storable(values: NDArray[Any], kind: str) -> NDArray[Any]:
    """The values in a type that the format has: .msh has one, .xdmf no short integers."""
    if kind == ".msh":
        return values.astype(np.float64)
    if values.dtype == np.float16:
        return values.astype(np.float32)
    if values.dtype.kind == "b" and kind == ".vtu":
        return values.astype(np.uint8)
    return values.astype(np.int32) if kind == ".xdmf" and values.dtype.itemsize < 4 else values
