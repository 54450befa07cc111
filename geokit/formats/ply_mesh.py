"""Polygon file format (.ply), ASCII and binary of both byte orders: vertices and polygons of any precision."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.mesh_text import numbers
from geokit.formats.ply_header import PlyElement, PlyProperty, read_header
from geokit.formats.polygons import Body
from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "write_mesh"]


def read_mesh(path: Path) -> list[Body]:
    """Body of a .ply file: ``x y z`` of its vertices, ``vertex_indices`` of its faces; the rest is left out."""
    data = path.read_bytes()
    order, elements, start = read_header(data, path)
    if any(element.count and not element.properties for element in elements):
        raise FileFormatError(f"{path}: the header declares an element without properties; the file is damaged")
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FileFormatError(f"{path}: has no vertex element; a mesh needs vertices and faces")
    if "tristrips" in names and "face" not in names:
        raise FileFormatError(f"{path}: holds triangle strips, which geokit does not read; export it as faces")
    source = _Text(data[start:], path) if order == "" else _Binary(data, start, order, path)
    points = np.zeros((0, 3))
    counts = indices = np.zeros(0, np.int64)
    for element in elements:
        columns = source.read(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= columns.keys():
                raise FileFormatError(f"{path}: the vertices have no x, y and z; the file is not a mesh")
            points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        elif element.name == "face":
            found = columns.get("vertex_indices", columns.get("vertex_index"))
            if not isinstance(found, tuple):
                raise FileFormatError(f"{path}: the faces have no list vertex_indices; export the mesh again")
            counts, indices = found
            if indices.dtype.kind not in "iu":
                raise FileFormatError(f"{path}: vertex_indices are not integers; export the mesh again")
    source.finish()
    return [Body(points, counts, indices)]


def _truncated(path: Path, element: PlyElement) -> FileFormatError:
    return FileFormatError(
        f"{path}: ends within the {element.count} {element.name} entries it declares; it is truncated, get a whole copy"
    )


class _Text:
    """Elements of an ASCII body, one after the other."""

    def __init__(self, body: bytes, path: Path) -> None:
        self.tokens, self.at, self.path = body.split(), 0, path

    def read(self, element: PlyElement) -> dict[str, Any]:
        table = self._uniform(element)
        if table is not None:
            return table
        values: dict[str, list[bytes]] = {item.name: [] for item in element.properties}
        sizes: dict[str, list[int]] = {item.name: [] for item in element.properties if item.count_type}
        for _ in range(element.count):
            for item in element.properties:
                size = 1
                if item.count_type:
                    token = self._take(1, element)[0]
                    # Tokens such as "3.0" are no counts; -1 would walk backwards.
                    size = int(token) if token.isdigit() else len(self.tokens)
                    sizes[item.name].append(size)
                values[item.name] += self._take(size, element)
        return {item.name: self._column(item, values[item.name], sizes.get(item.name)) for item in element.properties}

    def finish(self) -> None:
        if self.at != len(self.tokens):
            raise FileFormatError(
                f"{self.path}: holds {len(self.tokens) - self.at} values more than it declares; the file is damaged"
            )

    def _take(self, count: int, element: PlyElement) -> list[bytes]:
        if self.at + count > len(self.tokens):
            raise _truncated(self.path, element)
        self.at += count
        return self.tokens[self.at - count : self.at]

    def _uniform(self, element: PlyElement) -> dict[str, Any] | None:
        """The element as one table, where all its lists have the length that the first ones have."""
        stride, places = 0, []
        for item in element.properties:
            places.append(stride)
            if item.count_type:
                token = self.tokens[self.at + stride] if self.at + stride < len(self.tokens) else b""
                if not token.isdigit():
                    return None
                stride += int(token)
            stride += 1
        used = stride * element.count
        if self.at + used > len(self.tokens):
            return None
        tokens = self.tokens[self.at : self.at + used]
        columns: dict[str, Any] = {}
        for item, place, end in zip(element.properties, places, [*places[1:], stride], strict=True):
            if not item.count_type:
                columns[item.name] = self._column(item, tokens[place::stride], None)
                continue
            size = end - place - 1
            if any(token != tokens[place] for token in tokens[place::stride]):
                return None
            rows = [tokens[place + 1 + corner :: stride] for corner in range(size)]
            flat = [token for row in zip(*rows, strict=True) for token in row]
            columns[item.name] = self._column(item, flat, [size] * element.count)
        self.at += used
        return columns

    def _column(self, item: PlyProperty, tokens: list[bytes], sizes: list[int] | None) -> Any:
        # The text holds more digits than a float32 property keeps: nothing is gained by rounding them away.
        dtype = np.float64 if item.type.startswith("f") else np.int64
        values = numbers(tokens, dtype, self.path, f"property {item.name}")
        return values if sizes is None else (np.asarray(sizes, np.int64), values)


class _Binary:
    """Elements of a binary body, one after the other."""

    def __init__(self, data: bytes, start: int, order: str, path: Path) -> None:
        self.data, self.at, self.order, self.path = data, start, order, path

    def read(self, element: PlyElement) -> dict[str, Any]:
        sizes = self._first_sizes(element)
        columns = self._table(element, sizes)
        return self._walk(element) if columns is None else columns

    def finish(self) -> None:
        if self.data[self.at :].strip():
            raise FileFormatError(
                f"{self.path}: holds {len(self.data) - self.at} bytes more than it declares; the file is damaged"
            )

    def _first_sizes(self, element: PlyElement) -> list[int]:
        at, sizes = self.at, []
        for item in element.properties:
            size = 1
            if item.count_type:
                size = self._count(at, item, element) if element.count else 0
                at += np.dtype(item.count_type).itemsize
            at += size * np.dtype(item.type).itemsize
            sizes.append(size)
        return sizes

    def _table(self, element: PlyElement, sizes: list[int]) -> dict[str, Any] | None:
        """The element as one structured array; None where a list has another length than its first."""
        fields: list[Any] = []
        for number, (item, size) in enumerate(zip(element.properties, sizes, strict=True)):
            if item.count_type:
                fields.append((f"n{number}", self.order + item.count_type))
                fields.append((f"v{number}", self.order + item.type, (size,)))
            else:
                fields.append((f"v{number}", self.order + item.type))
        dtype = np.dtype(fields)
        lists = any(item.count_type for item in element.properties)
        if self.at + dtype.itemsize * element.count > len(self.data):
            if lists:
                return None
            raise _truncated(self.path, element)
        table = np.frombuffer(self.data, dtype, element.count, self.at)
        columns: dict[str, Any] = {}
        for number, (item, size) in enumerate(zip(element.properties, sizes, strict=True)):
            values = table[f"v{number}"]
            if item.count_type:
                if np.any(table[f"n{number}"] != size):
                    return None
                columns[item.name] = (np.full(element.count, size, np.int64), self._integers(values.ravel()))
            else:
                columns[item.name] = values
        self.at += dtype.itemsize * element.count
        return columns

    def _walk(self, element: PlyElement) -> dict[str, Any]:
        """Entry by entry: lists of several lengths have no other order than the file's."""
        pieces: dict[str, list[bytes]] = {item.name: [] for item in element.properties}
        sizes: dict[str, list[int]] = {item.name: [] for item in element.properties}
        widths = [np.dtype(item.type).itemsize for item in element.properties]
        for _ in range(element.count):
            for item, width in zip(element.properties, widths, strict=True):
                size = 1
                if item.count_type:
                    size = self._count(self.at, item, element)
                    self.at += np.dtype(item.count_type).itemsize
                end = self.at + size * width
                if end > len(self.data):
                    raise _truncated(self.path, element)
                pieces[item.name].append(self.data[self.at : end])
                sizes[item.name].append(size)
                self.at = end
        columns: dict[str, Any] = {}
        for item in element.properties:
            values = np.frombuffer(b"".join(pieces[item.name]), self.order + item.type)
            counts = np.asarray(sizes[item.name], np.int64)
            columns[item.name] = (counts, self._integers(values)) if item.count_type else values
        return columns

    def _count(self, at: int, item: PlyProperty, element: PlyElement) -> int:
        code = self.order + np.dtype(item.count_type).char
        try:
            size = struct.unpack_from(code, self.data, at)[0]
        except struct.error:
            raise _truncated(self.path, element) from None
        if not isinstance(size, int) or size < 0 or size > len(self.data):
            raise FileFormatError(f"{self.path}: a list of {size} {item.name} in a {element.name}; the file is damaged")
        return size

    def _integers(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.astype(np.int64) if values.dtype.kind in "iu" else values


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Binary, little endian, with float64 vertices."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment by geokit\n"
        f"element vertex {len(mesh.vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    records["count"] = 3
    records["corners"] = mesh.faces
    with open(path, "wb") as file:
        file.write(header.encode("ascii") + mesh.vertices.astype("<f8").tobytes() + records.tobytes())
