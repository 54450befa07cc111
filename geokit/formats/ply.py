"""Polygon file format (.ply), ASCII and binary of both byte orders: meshes, and points with attributes."""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, InputError
from geokit.formats.attributes.columns import as_columns, free_name, from_columns
from geokit.formats.attributes.mtl import image_content
from geokit.formats.columns import AXES, Columns, joined, split
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.formats.text_files.decimal import SMALLEST, plain_rows
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.words import as_number, numbers
from geokit.mesh.model.data import as_bytes, has_meaning

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
# The first line, behind a byte order mark of UTF-8 in binary files too; the line that says that a file is binary.
_MAGIC = re.compile(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r?\n|\r)", re.IGNORECASE)
_END = re.compile(rb"end_header", re.IGNORECASE)
_BINARY, _HEAD_BYTES = re.compile(rb"[\r\n]\s*format\s+binary", re.IGNORECASE), 1 << 12
# MeshLab's line for an image of the base color; "texnumber" of a face is the row of its image.
_IMAGE = re.compile(rb"^comment[ \t]+TextureFile[ \t]+(.+?)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "b1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


@dataclass
class _Property:
    """A property of an element: its name and NumPy type; ``count_type`` is that of a list's length, "" for a scalar."""

    name: str
    type: str
    count_type: str = ""


@dataclass
class _Element:
    """An element: its name, the number of its entries, and their properties."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def read_mesh(path: Path, folders: Sequence[Path] = ()) -> list[Body]:
    """Read a .ply file: vertices and faces with all their properties, each in its type; strips become triangles.

    Lists of faces with a number, or several, for each corner are on corners: ``texcoord`` is ``uv``. Each image that
    ``comment TextureFile`` names is a material; it may lie beside the file, or within ``folders``.
    """
    data = path.read_bytes()
    if not _BINARY.search(data[:_HEAD_BYTES]):
        data = plain_text(data, path)
    order, elements, start = read_header(data, path)
    if any(element.count and not element.properties for element in elements):
        raise FileFormatError(f"{path}: the header declares an element without properties; the file is damaged")
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FileFormatError(f"{path}: has no vertex element; a mesh needs vertices and faces")
    source = _Text(data[start:], path) if order == "" else _Binary(data, start, order, path)
    points = np.zeros((0, 3))
    counts = indices = np.zeros(0, np.int64)
    strips = np.zeros((0, 3), np.int64)
    vertex: Columns = {}
    face: Columns = {}
    corner: Columns = {}
    notes: list[str] = []
    for element in elements:
        columns = source.read(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= columns.keys():
                for item in element.properties:
                    item.name = item.name.lower() if item.name in ("X", "Y", "Z") else item.name
                columns = {item.name: columns[name] for item, name in zip(element.properties, columns, strict=True)}
            if not {"x", "y", "z"} <= columns.keys():
                raise FileFormatError(f"{path}: the vertices have no x, y and z; the file is not a mesh")
            points = np.stack([columns.pop(axis).astype(np.float64) for axis in "xyz"], axis=1)
            vertex, lists = _attributes(columns, element)
            notes += [f"the list {name!r} of the vertices is left out" for name in lists]
        elif element.name in ("face", "tristrips"):
            found = columns.pop("vertex_indices", None) or columns.pop("vertex_index", None)
            if not isinstance(found, tuple):
                raise FileFormatError(f"{path}: the faces have no list vertex_indices; export the mesh again")
            if found[1].dtype.kind not in "iu":
                raise FileFormatError(f"{path}: vertex_indices are not integers; export the mesh again")
            if element.name == "tristrips":
                strips = _triangles_of_strips(*found)
                continue
            counts, indices = found
            face, lists = _attributes(columns, element)
            for name, (sizes, values) in lists.items():
                found = _on_corners(sizes, values, counts)
                if found is not None:
                    corner["uv" if name == "texcoord" and found.shape[1:] == (2,) else name] = found
                elif len(values):
                    notes.append(f"the list {name!r} of the faces is left out: its lengths are not those of the faces")
        elif element.count:
            notes.append(f"its {element.count} entries of {element.name!r} are left out")
    source.finish()
    if len(strips):
        left_out = [f"{name!r} of the faces is left out beside strips" for name in (*face, *corner)]
        notes, face, corner = notes + left_out, {}, {}
        counts, indices = np.concatenate([counts, np.full(len(strips), 3)]), np.concatenate([indices, strips.ravel()])
    images = [name.decode("utf-8", "replace") for name in _IMAGE.findall(data[:start].replace(b"\r", b"\n"))]
    if images:
        rows: NDArray[Any] = np.asarray(face.pop("texnumber", np.zeros(len(counts))), np.float64)
        face["material"] = np.where((rows >= 0) & (rows < len(images)), rows, -1).astype(np.int32)
    materials = [
        FileMaterial(plain, None, plain, image_content(name, path, folders, notes))
        for name in images
        for plain in [PurePosixPath(name.replace("\\", "/")).name]
    ]
    return [
        Body(
            points,
            counts,
            indices,
            vertex_data=_with_bytes(from_columns(vertex), "color"),
            polygon_data=_with_bytes(from_columns(face), "color"),
            corner_data=corner,
            materials=tuple(materials),
            notes=tuple(notes),
        )
    ]


def _triangles_of_strips(counts: NDArray[np.int64], indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (T, 3) of strips; -1 ends a strip as the end of its list does, and a repeated index joins two."""
    ends = np.concatenate([[0], np.cumsum(counts)])[1:-1]
    corners = np.insert(indices, ends, -1)
    places = np.arange(len(corners))
    first = np.maximum.accumulate(np.where(corners < 0, places + 1, 0))
    found = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1) if len(corners) > 2 else np.zeros((0, 3), int)
    # The file winds every second triangle of a strip the other way.
    turned = (places - first)[: len(found)] % 2 == 1
    found[turned] = found[turned][:, [1, 0, 2]]
    a, b, c = found.T
    return found[(found >= 0).all(axis=1) & (a != b) & (b != c) & (c != a)]


def _on_corners(sizes: NDArray[Any], values: NDArray[Any], counts: NDArray[Any]) -> NDArray[Any] | None:
    """Rows of corners, if a list has as many numbers for each of them, or is empty (NaN, 0 in integers); else None."""
    full = sizes > 0
    width = int(sizes[full].sum() // max(counts[full].sum(), 1))
    if not width or np.any(sizes[full] != counts[full] * width):
        return None
    table = np.full((counts.sum(), width), np.nan if values.dtype.kind == "f" else 0, values.dtype)
    table[np.repeat(full, counts)] = values.reshape(-1, width)
    return table[:, 0] if width == 1 else table


def _attributes(columns: dict[str, Any], element: _Element) -> tuple[Columns, dict[str, Any]]:
    """The other columns of an element in their types, and its lists."""
    single: Columns = {}
    lists: dict[str, Any] = {}
    for item in element.properties:
        found = columns.get(item.name)
        if isinstance(found, tuple):
            lists[item.name] = found[0], _typed(found[1], item.type)
        elif found is not None:
            single[item.name] = _typed(found, item.type)
    return single, lists


def _typed(values: NDArray[Any], kind: str) -> NDArray[Any]:
    """The values in their declared type; as they are where text holds integers that do not fit."""
    with np.errstate(over="ignore"):
        typed = values.astype(kind)
    return typed if typed.dtype.kind == "f" or np.array_equal(typed, values) else values


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the vertices and all their numeric properties, each in the type of the file.

    Raises:
        FileFormatError: The file is damaged or truncated, has no vertices, or has a list among their properties.
    """
    data = path.read_bytes()
    if not _BINARY.search(data[:_HEAD_BYTES]):
        data = plain_text(data, path)
    order, elements, start = read_header(data, path)
    if "vertex" not in [element.name for element in elements]:
        raise FileFormatError(f"{path}: has no vertex element; a point set needs one")
    vertex = elements[0]
    if vertex.name != "vertex":
        raise FileFormatError(f"{path}: element {vertex.name!r} stands before the vertices; put the vertices first")
    if not vertex.properties:
        return joined({}, path)
    dtype = vertex_record(vertex, order, len(data) - start, path).newbyteorder("=")
    if order == "":
        points, arrays = joined(_ascii(data[start:], dtype, vertex.count, path), path)
        return points, _with_bytes(arrays, "rgb")
    columns = _Binary(data, start, order, path).read(vertex)
    points, arrays = joined({name: values.astype(dtype[name]) for name, values in columns.items()}, path)
    return points, _with_bytes(arrays, "rgb")


def vertex_record(vertex: _Element, order: str, room: int, path: Path) -> np.dtype[np.void]:
    """The numbers of a vertex, in the file's byte order; those of a binary file fit into ``room`` bytes.

    Raises:
        FileFormatError: One of them is a list, or the file ends before the last vertex.
    """
    lists = [item.name for item in vertex.properties if item.count_type]
    if lists:
        raise FileFormatError(f"{path}: vertex property {lists[0]!r} is a list, which geokit does not read; remove it")
    record = np.dtype([(item.name, order + item.type) for item in vertex.properties])
    have = room // max(record.itemsize, 1)
    if order and have < vertex.count:
        raise FileFormatError(f"{path}: ends in vertex {have} of the {vertex.count} it declares; get a whole copy")
    return record


def _with_bytes(data: dict[str, NDArray[Any]], name: str) -> dict[str, NDArray[Any]]:
    """The arrays, colors as bytes where these say the same."""
    return {**data, name: as_bytes(data[name])} if name in data else data


def _ascii(body: bytes, dtype: np.dtype[np.void], count: int, path: Path) -> dict[str, NDArray[np.generic]]:
    names = dtype.names or ()
    table = _plain(body, count)
    if table is not None and table.shape == (count, len(names)):
        with contextlib.suppress(FloatingPointError):
            return _cast(table, dtype)
    lines = [line for line in body.split(b"\n") if line.strip()][:count]
    if len(lines) < count:
        raise FileFormatError(f"{path}: ends in vertex {len(lines)} of the {count} it declares; get a whole copy")
    tokens = b" ".join(lines).split()
    with contextlib.suppress(ValueError, FloatingPointError, FileFormatError):
        return _cast(numbers(tokens, np.float64, path, "vertices").reshape(count, len(names)), dtype)
    for row, line in enumerate(lines):
        words = line.decode("latin-1").split()
        if len(words) == len(names) and all(as_number(word) is not None for word in words):
            continue
        shown = line[:60].decode("ascii", "backslashreplace").strip()
        raise FileFormatError(f"{path}: vertex {row} ({shown!r}) is not {len(names)} numbers; the file is damaged")
    raise FileFormatError(f"{path}: a vertex has a number that its type cannot hold; the file is damaged")


def _plain(body: bytes, count: int) -> NDArray[np.float64] | None:
    """The first ``count`` lines, if they are many and plain numbers; faces may follow them."""
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n")) if len(body) >= SMALLEST else np.empty(0)
    return plain_rows(body, 0, int(ends[count - 1])) if 0 < count <= len(ends) else None


def _cast(table: NDArray[np.float64], dtype: np.dtype[np.void]) -> dict[str, NDArray[np.generic]]:
    with np.errstate(invalid="raise", over="ignore"):
        return {name: table[:, at].astype(dtype[name]) for at, name in enumerate(dtype.names or ())}


def lacks_faces(head: bytes) -> bool:
    """Whether the header declares no faces."""
    header = _END.split(head, 1)[0].replace(b"\r", b"\n")
    faces = re.findall(rb"^\s*element\s+(?:face|tristrips)\s+(\d+)", header, re.MULTILINE | re.IGNORECASE)
    return bool(_MAGIC.match(head)) and not any(map(int, faces))


def read_header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    """Byte order ("" for ASCII, "<" or ">"), the elements in file order, and the offset of the body.

    Raises:
        FileFormatError: The file is not a .ply file, the header lacks its end or format, or a line is not understood.
    """
    magic = _MAGIC.match(data)
    if magic is None:
        raise FileFormatError(f"{path}: does not start with 'ply'; the file is damaged or not a .ply file")
    last = _END.search(data)
    end = -1 if last is None else last.start()
    newline = data.find(b"\r" if magic[1] == b"\r" else b"\n", end)
    if end < 0 or newline < 0:
        raise FileFormatError(f"{path}: the header has no end; the file is truncated, get a whole copy")
    order = None
    elements: list[_Element] = []
    # Names of the elements, and of the properties of the last one.
    taken: set[str] = set()
    known: set[str] = set()
    # Other bytes that split lines of text may stand in comments.
    for line in re.split(r"\r\n|\r|\n", data[:end].decode("latin-1"))[1:]:
        words = line.split()
        try:
            words[:2] = [word.lower() for word in words[:2]]
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element" and words[2].isdecimal() and words[1] not in taken:
                elements.append(_Element(words[1], int(words[2])))
                taken.add(words[1])
                known = set()
            elif words[0] == "property" and words[-1] not in known:
                elements[-1].properties.append(_property(words))
                known.add(words[-1])
            else:
                raise ValueError(line)
        except (ValueError, KeyError, IndexError):
            raise FileFormatError(f"{path}: header line {line[:80]!r} is not understood; the file is damaged") from None
    if order is None:
        raise FileFormatError(f"{path}: the header names no format; the file is damaged")
    return order, elements, newline + 1


def _property(words: list[str]) -> _Property:
    if words[1] == "list":
        _, _, counts, kind, name = words
        return _Property(name, _TYPES[kind.lower()], _TYPES[counts.lower()])
    _, kind, name = words
    return _Property(name, _TYPES[kind])


def _truncated(path: Path, element: _Element) -> FileFormatError:
    return FileFormatError(
        f"{path}: ends within the {element.count} {in_one_line(element.name)} entries it declares; it is truncated, "
        "get a whole copy"
    )


class _Text:
    """Reader of the elements of an ASCII body, one after the other."""

    def __init__(self, body: bytes, path: Path) -> None:
        self.tokens, self.at, self.path = body.split(), 0, path

    def read(self, element: _Element) -> dict[str, Any]:
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
                    # Tokens such as "3.0" are not counts, and -1 would move backwards.
                    size = int(token) if token.isdigit() else len(self.tokens)
                    sizes[item.name].append(size)
                values[item.name] += self._take(size, element)
        return {item.name: self._column(item, values[item.name], sizes.get(item.name)) for item in element.properties}

    def finish(self) -> None:
        if self.at != len(self.tokens):
            raise FileFormatError(
                f"{self.path}: holds {len(self.tokens) - self.at} values more than it declares; the file is damaged"
            )

    def _take(self, count: int, element: _Element) -> list[bytes]:
        if self.at + count > len(self.tokens):
            raise _truncated(self.path, element)
        self.at += count
        return self.tokens[self.at - count : self.at]

    def _uniform(self, element: _Element) -> dict[str, Any] | None:
        """The element as one table, if all its lists have the same lengths as the first ones; else None."""
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

    def _column(self, item: _Property, tokens: list[bytes], sizes: list[int] | None) -> Any:
        # The text has more digits than a float32 property keeps, so they are not rounded away.
        dtype = np.float64 if item.type.startswith("f") else np.int64
        values = numbers(tokens, dtype, self.path, f"property {item.name}")
        return values if sizes is None else (np.asarray(sizes, np.int64), values)


class _Binary:
    """Reader of the elements of a binary body, one after the other."""

    def __init__(self, data: bytes, start: int, order: str, path: Path) -> None:
        self.data, self.at, self.order, self.path = data, start, order, path

    def read(self, element: _Element) -> dict[str, Any]:
        sizes = self._first_sizes(element)
        columns = self._table(element, sizes)
        return self._walk(element) if columns is None else columns

    def finish(self) -> None:
        if self.data[self.at :].strip():
            raise FileFormatError(
                f"{self.path}: holds {len(self.data) - self.at} bytes more than it declares; the file is damaged"
            )

    def _first_sizes(self, element: _Element) -> list[int]:
        at, sizes = self.at, []
        for item in element.properties:
            size = 1
            if item.count_type:
                size = self._count(at, item, element) if element.count else 0
                at += np.dtype(item.count_type).itemsize
            at += size * np.dtype(item.type).itemsize
            sizes.append(size)
        return sizes

    def _table(self, element: _Element, sizes: list[int]) -> dict[str, Any] | None:
        """The element as one structured array; None if a list has another length than its first."""
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

    def _walk(self, element: _Element) -> dict[str, Any]:
        """Read entry by entry: lists of varying lengths can only be read in the file's order."""
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

    def _count(self, at: int, item: _Property, element: _Element) -> int:
        code = self.order + np.dtype(item.count_type).char
        try:
            size = struct.unpack_from(code, self.data, at)[0]
        except struct.error:
            raise _truncated(self.path, element) from None
        if not isinstance(size, int) or size < 0 or size > len(self.data):
            raise FileFormatError(
                f"{self.path}: a list {item.name!r} of {size} in a {element.name!r}; the file is damaged"
            )
        return size

    def _integers(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.astype(np.int64) if values.dtype.kind in "iu" else values


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a binary file, little endian, with float64 vertices; arrays on corners become lists of faces."""
    vertex = _columns(_written(mesh.vertex_data, "color"), AXES)
    lists: dict[str, NDArray[Any]] = {"vertex_indices": mesh.faces}
    for name, values in mesh.corner_data.items():
        uv = name == "uv" and has_meaning(name, values, 2)
        table = _fitting(values.reshape(len(values), -1), name)
        lists[free_name("texcoord" if uv else name, {*lists, "vertex_index"})] = table
    face = _columns(_written(mesh.face_data, "color"), (*lists, "vertex_index"))
    header = ["ply", "format binary_little_endian 1.0", "comment by geokit", f"element vertex {len(mesh.vertices)}"]
    header += ["property double x", "property double y", "property double z", *_properties(vertex)]
    header += [f"element face {len(mesh.faces)}"]
    records: list[Any] = []
    for name, table in lists.items():
        size = "uchar" if table.shape[1] < 256 else "int"
        header.append(f"property list {size} {_NAMES[table.dtype.str[1:]]} {name}")
        records += [(f"{name} count", "<" + _TYPES[size]), (name, table.dtype.newbyteorder("<"), table.shape[1:])]
    faces = np.empty(len(mesh.faces), [*records, *_fields(face)])
    for name, table in lists.items():
        faces[f"{name} count"], faces[name] = table.shape[1], table
    for name, column in face.items():
        faces[name] = column
    header += [*_properties(face), "end_header"]
    content = _table(mesh.vertices, vertex) if vertex else mesh.vertices.astype("<f8")
    with open(path, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii") + content.tobytes() + faces.tobytes())


def _written(data: Mapping[str, NDArray[Any]], name: str) -> Mapping[str, NDArray[Any]]:
    """The arrays, colors as bytes where these say the same: VTK and Open3D take all numbers for bytes."""
    if name not in data or data[name].ndim != 2 or data[name].shape[1] not in (3, 4):
        return data
    given = _with_bytes(dict(data), name)
    colors = given[name]
    if colors.dtype != np.uint8 and colors.dtype.kind in "fiu":
        share = f"{name} / {np.iinfo(colors.dtype).max}" if colors.dtype.kind in "iu" else name
        warn(
            f".ply: {name!r} of {colors.dtype} is kept, but other programs take all colors of .ply for bytes and show "
            f"these wrong; write .vtp or another format for them, or round to bytes in Python: np.rint({share} * "
            "255).astype(np.uint8)"
        )
    return given


def holds_type(values: NDArray[Any], _kind: str) -> bool:
    """Whether integers fit into 32 bits."""
    return values.dtype.kind not in "iu" or values.dtype.itemsize < 8 or _fits(values)


def _fits(values: NDArray[Any]) -> bool:
    limits = np.iinfo(np.int32)
    return not values.size or bool(limits.min <= values.min() and values.max() <= limits.max)


def _columns(data: Mapping[str, NDArray[Any]], taken: tuple[str, ...]) -> Columns:
    return {name: _fitting(column, name) for name, column in as_columns(data, taken).items()}


def _properties(columns: Columns) -> list[str]:
    return [f"property {_NAMES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]


def _fields(columns: Columns) -> list[Any]:
    return [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]


def _table(points: NDArray[np.float64], columns: Columns) -> NDArray[np.void]:
    """Records of positions and columns."""
    every = {**dict(zip(AXES, points.T, strict=True)), **columns}
    table = np.empty(len(points), _fields(every))
    for name, column in every.items():
        table[name] = column
    return table


def write_points(path: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> None:
    """Write a binary little-endian file with one vertex element, and colors as bytes where these are exact.

    Raises:
        InputError: A name cannot be that of a property, or a column has a type that the format lacks and fits into none
            that it has.
    """
    data = _written(data, "rgb")
    with open(path, "wb") as file:
        file.write(points_header(points, data, len(points)))
        file.write(points_body(points, data))


def points_header(points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]], count: int) -> bytes:
    """The header of ``count`` points, of which some, or none, are given."""
    columns = _point_columns(points, data)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *_properties(columns)]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii")


def points_body(points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Points as they stand after the header."""
    return _table(points, _point_columns(points, data)).tobytes()


def _point_columns(points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]]) -> Columns:
    return {name: _fitting(column, name) for name, column in split(points, data, ".ply").items()}


def _fitting(column: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    if column.dtype.str[1:] in _NAMES:
        return column.astype(np.uint8) if column.dtype.kind == "b" else column
    if column.dtype.kind == "f":
        return column.astype(np.float64 if column.dtype.itemsize > 4 else np.float32)
    if not _fits(column):
        raise InputError(f"data: '{name}' has integers beyond 32 bits, which .ply cannot hold; write .npz or .vtp")
    return column.astype(np.int32)
