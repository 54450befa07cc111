"""XDMF: one grid, with its arrays in the file, in HDF5 or in files of plain numbers."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import damaged
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats.file_content.references import LONGEST, require_inside

# Soft links of HDF5, or references of items, that lead to each other.
LONGEST_CHAIN = 16
_TYPES = {
    **{("int", size): f"i{size}" for size in "1248"},
    **{("uint", size): f"u{size}" for size in "1248"},
    **{("float", size): f"f{size}" for size in "48"},
    **{("char", size): "i1" for size in "14"},
    **{("uchar", size): "u1" for size in "14"},
}  # fmt: skip
# Cells in arrays of mixed types: number, nodes, meshio's name.
_MIXED = {
    4: (3, "triangle"), 5: (4, "quad"), 6: (4, "tetra"), 7: (5, "pyramid"), 8: (6, "wedge"), 9: (8, "hexahedron"),
    34: (3, "line3"), 35: (9, "quad9"), 36: (6, "triangle6"), 37: (8, "quad8"), 38: (10, "tetra10"),
    39: (13, "pyramid13"), 40: (15, "wedge15"), 41: (18, "wedge18"), 48: (20, "hexahedron20"),
    49: (24, "hexahedron24"), 50: (27, "hexahedron27"),
}  # fmt: skip
# Those that are followed by a count, and by faces with counts of their own.
_COUNTED, _POLYHEDRON = {1: "vertex", 2: "line", 3: "polygon"}, 16
_NAMES = {
    "polyvertex": "vertex", "polyline": "line", "polygon": "polygon", "triangle": "triangle", "quadrilateral": "quad",
    "tetrahedron": "tetra", "pyramid": "pyramid", "wedge": "wedge", "hexahedron": "hexahedron", "edge_3": "line3",
    "triangle_6": "triangle6", "tri_6": "triangle6", "quadrilateral_8": "quad8", "quad_8": "quad8",
    "quadrilateral_9": "quad9", "quad_9": "quad9", "tetrahedron_10": "tetra10", "tet_10": "tetra10",
    "pyramid_13": "pyramid13", "wedge_15": "wedge15", "wedge_18": "wedge18", "hexahedron_20": "hexahedron20",
    "hex_20": "hexahedron20", "hexahedron_24": "hexahedron24", "hex_24": "hexahedron24",
    "hexahedron_27": "hexahedron27", "hex_27": "hexahedron27",
}  # fmt: skip
_NODES = {name: count for count, name in _MIXED.values()}


def read_grid(path: Path, folders: Sequence[Path], step: int | None) -> tuple[Any, int, list[str]]:
    """The grid as meshio has it, the number of its first vertex, and notes on what is left out."""
    from xml.etree import ElementTree

    meshio = require_package("meshio")
    root = ElementTree.parse(path).getroot()
    # Also those that are not in the chosen step.
    items = list(root.iter())
    _choose_grid(path, root, step)
    if root.tag != "Xdmf":
        raise FileFormatError(f"{path}: its outermost element is {root.tag[:40]}, not Xdmf")
    version = root.get("Version", "3")
    if version.split(".")[0] not in ("2", "3"):
        raise FileFormatError(f"{path}: is of version {version[:20]} of XDMF; export version 2 or 3")
    first, notes = _numbering(path, root)
    _check_arrays(path, folders, items)
    grid = root.find("Domain/Grid")
    geometry, topology = (None, None) if grid is None else (grid.find("Geometry"), grid.find("Topology"))
    if grid is None or geometry is None or topology is None:
        raise FileFormatError(f"{path}: has no grid with geometry and topology; export a surface of triangles")
    width = 2 if geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper() == "XY" else 3
    points = _only_item(path, root, geometry)
    if points.size % width:
        raise FileFormatError(f"{path}: its {points.size} coordinates are not those of points of {width}")
    points = points.reshape(-1, width)
    cells = _cells(path, root, topology)
    counts = {"Node": len(points), "Cell": sum(len(data) for _, data in cells)}
    arrays: dict[str, dict[str, NDArray[Any]]] = {"Node": {}, "Cell": {}}
    for found in grid.findall("Attribute"):
        center, name = found.get("Center", "Node"), found.get("Name", "")
        values, count = _only_item(path, root, found), counts[center]
        if len(values) != count and count and values.size and values.size % count == 0:
            values = values.reshape(count, -1)
        if len(values) == count:
            arrays[center][name] = values
        else:
            notes.append(f"the array {name[:100]!r} is left out: it has {len(values)} rows, not {count}")
    ends = np.cumsum([len(data) for _, data in cells])[:-1]
    split = {name: np.split(values, ends) for name, values in arrays["Cell"].items()}
    return meshio.Mesh(points, cells, point_data=arrays["Node"], cell_data=split), first, notes


# --- Cells ------------------------------------------------------------------------------------------------------------


def _cells(path: Path, root: Any, topology: Any) -> list[tuple[str, Any]]:
    """Blocks of cells of one type; lines and points have one column each, for they are only counted."""
    told = topology.get("TopologyType", topology.get("Type", ""))
    data = _only_item(path, root, topology)
    if told.lower() == "mixed":
        blocks = _mixed(path, data.ravel())
    else:
        kind = _NAMES.get(told.lower())
        if kind is None:
            raise _unread(path, told)
        nodes = _NODES.get(kind) or int(topology.get("NodesPerElement", data.shape[-1] if data.ndim > 1 else 0))
        if nodes < 1 or data.size % nodes:
            raise damaged(path, f"its {data.size} corners are not those of cells of {nodes}")
        rows = data.reshape(-1, nodes)
        blocks = [(kind, list(rows) if kind == "polygon" else rows)]
    declared, count = topology.get("NumberOfElements", topology.get("Dimensions")), sum(len(rows) for _, rows in blocks)
    if declared is not None and math.prod(int(number) for number in declared.split()) != count:
        raise damaged(path, f"declares {declared[:40]} cells and holds {count}")
    return blocks


def _unread(path: Path, kind: object) -> FileFormatError:
    return FileFormatError(
        f"{path}: has cells of the type {str(kind)[:40]}, which are not read; export triangles or quads"
    )


def _mixed(path: Path, data: NDArray[Any]) -> list[tuple[str, Any]]:
    """Cells one after the other, each with its type, and where that does not tell it, its number of nodes."""
    found: list[tuple[str, list[Any]]] = []
    numbers, at = data.tolist(), 0
    try:
        while at < len(numbers):
            kind, start = numbers[at], at + 1
            if kind in _COUNTED:
                name, nodes, start = _COUNTED[kind], numbers[start], start + 1
            elif kind == _POLYHEDRON:
                name, faces, nodes = "polyhedron", numbers[start], 1
                for _ in range(faces):
                    nodes += 1 + numbers[start + nodes]
            elif kind in _MIXED:
                nodes, name = _MIXED[kind]
            else:
                raise _unread(path, kind)
            at = start + nodes
            if nodes < 1 or at > len(numbers):
                raise IndexError
            if not found or found[-1][0] != name:
                found.append((name, []))
            found[-1][1].append(numbers[start:at])
    except IndexError:
        raise FileFormatError(f"{path}: ends within a cell; the file is damaged, get a whole copy") from None
    # meshio knows neither points and lines of several nodes nor bodies of any faces: of these, only the number counts.
    same = {"vertex": ("vertex", 1), "line": ("line", 2), "polyhedron": ("tetra", 4)}
    return [
        (same[name][0], np.zeros((len(rows), same[name][1]), np.int64))
        if name in same
        else (name, [np.array(row) for row in rows] if name == "polygon" else np.array(rows))
        for name, rows in found
    ]


# --- Arrays -----------------------------------------------------------------------------------------------------------


def _only_item(path: Path, root: Any, element: Any) -> NDArray[Any]:
    items = [item for item in element if item.tag == "DataItem"]
    if len(items) != 1:
        raise FileFormatError(f"{path}: its {element.tag} has {len(items)} arrays, not one; export a plain grid")
    return _item(path, root, items[0])


def _item(path: Path, root: Any, item: Any, depth: int = 0) -> NDArray[Any]:
    if (kind := item.get("ItemType", "Uniform")).lower() != "uniform":
        raise FileFormatError(f"{path}: has an array of the type {kind[:40]}, which is not read; save plain arrays")
    if (reference := item.get("Reference")) is not None:
        pointer = (item.text or "" if reference == "XML" else reference).strip()
        try:
            target = root.find("./" + pointer.removeprefix("/Xdmf/")) if pointer.startswith("/Xdmf/") else None
        except SyntaxError:
            target = None
        if target is None or depth > LONGEST_CHAIN:
            raise FileFormatError(f"{path}: refers to {pointer[:LONGEST]!r}, which is not there; export it again")
        return _item(path, root, target, depth + 1)
    shape = [int(number) for number in item.get("Dimensions", "").split()]
    told = item.get("DataType", item.get("NumberType", "Float")), item.get("Precision", "4")
    dtype = _TYPES.get((told[0].lower(), told[1]))
    if dtype is None:
        raise FileFormatError(
            f"{path}: has numbers of the type {' '.join(told)[:40]!r}, which are not read; save floats or integers"
        )
    form = item.get("Format", "XML").upper()
    if form == "HDF":
        values = _hdf5(path, (item.text or "").strip())
    elif form == "BINARY":
        values = _binary(path, item, np.dtype(dtype), math.prod(shape))
    elif form == "XML":
        words = np.array((item.text or "").encode().split() or np.empty(0, "S1"))
        try:
            wide = words.astype(np.float64 if dtype[0] == "f" else np.int64)
        except (ValueError, OverflowError):
            # Integers may be written as 1.0.
            wide = words.astype(np.float64)
        with np.errstate(all="ignore"):
            values = wide.astype(dtype)
        values = values if dtype[0] == "f" or np.array_equal(values, wide) else wide
    else:
        raise FileFormatError(f"{path}: has an array of the format {form[:40]}, which is not read; save plain arrays")
    if shape and values.size != math.prod(shape):
        raise damaged(path, f"an array of the dimensions {shape} has {values.size} numbers")
    return values.reshape(shape or -1)


def _binary(path: Path, item: Any, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    """Numbers in the file's order of bytes from a place on."""
    orders: dict[str, Any] = {"big": ">", "little": "<", "native": "="}
    order = orders.get(item.get("Endian", "native").lower())
    if order is None or item.get("Compression", "Raw").lower() != "raw":
        raise FileFormatError(
            f"{path}: has binary numbers that are compressed or in an order of bytes that is not "
            "known; save them plainly, or in HDF5"
        )
    name, at = path.parent / (item.text or "").strip(), int(item.get("Seek", "0"))
    return np.fromfile(name, dtype.newbyteorder(order), count, offset=at).astype(dtype)


def _hdf5(path: Path, text: str) -> NDArray[Any]:
    name, _, inner = text.partition(":")
    with require_package("h5py").File(path.parent / name, "r") as file:
        values = np.asarray(file[inner][()])
    if values.dtype.kind not in "fiub":
        raise FileFormatError(f"{path}: the array {inner[:LONGEST]!r} holds no numbers; save floats or integers")
    return values


# --- What the file holds ----------------------------------------------------------------------------------------------


# Grid[@Name="mesh"], Grid[1], Grid.
_POINTED = re.compile(r"""Grid(?:\[@Name=["']([^"']*)["']\])?(?:\[(\d+)\])?""")


def _choose_grid(path: Path, root: Any, step: int | None) -> None:
    """Leave one grid in the content of an .xdmf: the only one, or that of a step of a time series.

    Raises:
        FileFormatError: It holds a series of times and no step is given, or not that one; several grids; or a geometry
            of separate arrays for each axis.
    """
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


def _numbering(path: Path, root: Any) -> tuple[int, list[str]]:
    """The number of the first vertex, and notes on arrays and sets that are left out.

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
        lost += [f"the set {found.get('Name', '')[:100]!r} is left out" for found in grid.findall("Set")]
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


def _check_arrays(path: Path, folders: Sequence[Path], items: list[Any]) -> None:
    """Check every file that the items of an .xdmf name, before one is opened."""
    for item in items:
        # References may lead to items of other tags.
        kind, text = item.get("Format", "XML").upper(), (item.text or "").strip()
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
