"""Triangles of binary .stl and .ply files, block after block."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import refuse_empty, require_extension, require_file
from geokit.errors import FileFormatError
from geokit.formats.ply import read_header
from geokit.formats.stl import HEADER_BYTES, RECORD, binary_count, left_behind
from geokit.formats.text_files.plain import without_mark

KINDS = (".ply", ".stl")
# The header of a .ply file ends within its first bytes.
LONGEST_HEADER = 1 << 20
REMEDY = "read it with mesh.load and save it as binary .ply or .stl"


@dataclass(frozen=True)
class TriangleFile:
    """Triangles in a file.

    Attributes:
        path: The file.
        count: Number of triangles.
        dtype: Type of the coordinates in the file, float32 or float64.
        read: Reads some triangles from a first one on: corners (N, 3, 3).
    """

    path: Path
    count: int
    dtype: np.dtype[Any]
    read: Callable[[int, int], NDArray[Any]]

    def blocks(self, rows: int) -> Iterator[NDArray[Any]]:
        """Corners (N, 3, 3) of the triangles in the file's order, at most ``rows`` at a time, in the file's type.

        Raises:
            FileFormatError: A triangle has a vertex that does not exist, or is none, or is not finite.
        """
        for first in range(0, self.count, rows):
            corners = self.read(first, min(rows, self.count - first))
            finite = np.isfinite(corners)
            if not finite.all():
                row = first + int(finite.all(axis=(1, 2)).argmin())
                raise FileFormatError(f"{self.path}: face {row} has a corner that is not finite; repair the mesh")
            yield corners


def open_triangles(path: Path) -> TriangleFile:
    """Read the header of a mesh file, and check its size.

    Raises:
        InputError: The extension is not .ply or .stl.
        FileAccessError: The file is missing or not readable.
        FileFormatError: The file is text, truncated, or has other faces than triangles.
    """
    kind = require_extension(path, KINDS, "binary mesh")
    path = require_file(path)
    refuse_empty(path)
    return _open_stl(path) if kind == ".stl" else _open_ply(path)


def _open_stl(path: Path) -> TriangleFile:
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(HEADER_BYTES)
    found = binary_count(head, size)
    if found is None:
        if without_mark(head).lstrip()[:5].lower() == b"solid":
            raise FileFormatError(f"{path}: is text, which has no blocks; {REMEDY}")
        declared = int.from_bytes(head[80:84], "little")
        raise FileFormatError(f"{path}: {size} bytes are not those of {declared} triangles; get a whole copy")
    count = found
    for note in left_behind(size, count):
        warn(f"{path}: {note}")

    def read(first: int, rows: int) -> NDArray[Any]:
        records = np.fromfile(path, RECORD, rows, offset=HEADER_BYTES + first * RECORD.itemsize)
        return _whole(records, rows, path)["corners"].astype(np.float32)

    return TriangleFile(path, count, np.dtype(np.float32), read)


def _open_ply(path: Path) -> TriangleFile:
    with open(path, "rb") as file:
        order, elements, at = read_header(file.read(LONGEST_HEADER), path)
    if order == "":
        raise FileFormatError(f"{path}: is text, which has no blocks; {REMEDY}")
    size = path.stat().st_size
    vertex: tuple[np.dtype[Any], int, int] | None = None
    face: tuple[np.dtype[Any], int, int] | None = None
    # Vertices may come behind the faces: of triangles, which are of one size, or what is read of them is refused.
    for element in elements:
        lists = [item for item in element.properties if item.count_type]
        if element.name in ("face", "tristrips"):
            kind, counts, corners = _face_record(element, order, path)
            face = kind, element.count, at
        elif lists:
            raise FileFormatError(
                f"{path}: {element.name} has the list {lists[0].name!r} before the faces or vertices; {REMEDY}"
            )
        else:
            kind = np.dtype([(item.name, order + item.type) for item in element.properties])
            vertex = (kind, element.count, at) if element.name == "vertex" else vertex
        at += element.count * kind.itemsize
        if vertex and face:
            break
    if vertex is None or not {"x", "y", "z"} <= set(vertex[0].names or ()):
        raise FileFormatError(f"{path}: has no vertices x, y, z; the file is not a mesh")
    if face is None:
        raise FileFormatError(f"{path}: has no faces; a mesh needs them")
    (kind, vertex_count, begin), (record, face_count, at) = vertex, face
    if size < begin + vertex_count * kind.itemsize:
        raise FileFormatError(f"{path}: ends within its {vertex_count} vertices; it is truncated, get a whole copy")
    if vertex_count == 0 or face_count == 0:
        return TriangleFile(path, 0, np.dtype(np.float32), lambda *_: np.zeros((0, 3, 3), np.float32))
    # Faces refer to vertices anywhere. The system keeps as many of these in memory as is free.
    vertices: Any = np.memmap(path, kind, "r", begin, (vertex_count,))
    plain = np.result_type(*(kind[axis] for axis in "xyz"))
    dtype = np.dtype(np.float32 if plain.kind == "f" and plain.itemsize == 4 else np.float64)

    def read(first: int, rows: int) -> NDArray[Any]:
        records = np.fromfile(path, record, rows, offset=at + first * record.itemsize)
        polygon = records[counts] != 3
        if polygon.any():
            row = int(polygon.argmax())
            raise FileFormatError(f"{path}: face {first + row} has {records[counts][row]} corners, not 3; {REMEDY}")
        indices = _whole(records, rows, path)[corners].astype(np.int64)
        wrong = ((indices < 0) | (indices >= vertex_count)).any(axis=1)
        if wrong.any():
            row = int(wrong.argmax())
            raise FileFormatError(
                f"{path}: face {first + row} has vertices {indices[row].tolist()} of {vertex_count}; the file is "
                "damaged, get a whole copy"
            )
        found = np.empty((rows, 3, 3), dtype)
        for axis, letter in enumerate("xyz"):
            found[..., axis] = vertices[letter][indices]
        # What was read stays in the system's cache; it should not count as memory of this process.
        if hasattr(mmap, "MADV_DONTNEED"):
            vertices._mmap.madvise(mmap.MADV_DONTNEED)
        return found

    return TriangleFile(path, face_count, dtype, read)


def _face_record(element: Any, order: str, path: Path) -> tuple[np.dtype[Any], str, str]:
    """The record of a triangle, and the names of its fields that hold the count and the vertices."""
    lists = [item for item in element.properties if item.count_type]
    if element.name != "face" or [item.name in ("vertex_indices", "vertex_index") for item in lists] != [True]:
        raise FileFormatError(f"{path}: its faces are more than lists of vertices; {REMEDY}")
    if lists[0].type[0] == "f" or lists[0].count_type[0] == "f":
        raise FileFormatError(f"{path}: vertex_indices are not integers; export the mesh again")
    fields: list[Any] = []
    for item in element.properties:
        fields += [("", order + item.count_type), ("", order + item.type, 3)] if item.count_type else []
        fields += [] if item.count_type else [("", order + item.type)]
    where = element.properties.index(lists[0])
    return np.dtype(fields), f"f{where}", f"f{where + 1}"


def _whole(records: NDArray[Any], rows: int, path: Path) -> NDArray[Any]:
    if len(records) < rows:
        raise FileFormatError(f"{path}: ends within the faces that it declares; it is truncated, get a whole copy")
    return records
