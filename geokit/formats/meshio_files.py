"""Gmsh's and Fluent's .msh and .xdmf, read in a separate process, Fluent's by meshio, which also writes .vtu."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.errors import FileFormatError
from geokit.formats.attributes.columns import as_columns, from_columns, xml_name
from geokit.formats.exchange.gmsh import is_gmsh, read_gmsh
from geokit.formats.exchange.xdmf import read_grid
from geokit.formats.file_content.body import Body
from geokit.formats.text_files.decimal import written_lines
from geokit.mesh.model.data import full_scale, has_meaning

if TYPE_CHECKING:
    from geokit.mesh.model.data import Data
    from geokit.mesh.model.triangle_mesh import TriangleMesh

_SURFACE = {"triangle", "quad", "polygon"}
# Cells of dimension 0 and 1.
_LESS = ("points", "lines")
# Numbers that a row may have; .vtu takes any.
_WIDTHS = {".msh": (1, 3, 9), ".xdmf": (1, 2, 3, 6, 9)}
# Beyond these a float64, the only type of .msh, does not hold each integer.
LARGEST_EXACT = 1 << 53


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
    if path.suffix.lower() == ".xdmf":
        mesh, first, notes = read_grid(path, folders, step)
    else:
        # Not meshio.read, which prints the reason and exits.
        first, notes = 0, []
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
        """Writes as many digits as a number needs: one more than meshio for float32, most often fewer for float64."""

        def numpy_to_xml_string(self, data: Any) -> Any:
            return "\n" + b"".join(written_lines(data)).decode("ascii")

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
