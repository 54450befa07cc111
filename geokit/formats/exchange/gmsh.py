"""Gmsh's .msh of versions 2 and 4, in ASCII and in binary of either order of bytes.

Nodes and elements have tags, which may be any numbers in any order; rows of arrays go to those whose tags they name.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.attributes.columns import from_columns
from geokit.formats.file_content.body import Body
from geokit.formats.text_files.decimal import plain_rows

# Number of nodes, dimension, name.
_TYPES = {
    1: (2, 1, "line"), 2: (3, 2, "triangle"), 3: (4, 2, "quad"), 4: (4, 3, "tetra"), 5: (8, 3, "hexahedron"),
    6: (6, 3, "wedge"), 7: (5, 3, "pyramid"), 8: (3, 1, "line3"), 9: (6, 2, "triangle6"), 10: (9, 2, "quad9"),
    11: (10, 3, "tetra10"), 12: (27, 3, "hexahedron27"), 13: (18, 3, "wedge18"), 14: (14, 3, "pyramid14"),
    15: (1, 0, "vertex"), 16: (8, 2, "quad8"), 17: (20, 3, "hexahedron20"), 18: (15, 3, "wedge15"),
    19: (13, 3, "pyramid13"), 20: (9, 2, "triangle9"), 21: (10, 2, "triangle10"), 22: (12, 2, "triangle12"),
    23: (15, 2, "triangle15"), 24: (15, 2, "triangle15"), 25: (21, 2, "triangle21"), 26: (4, 1, "line4"),
    27: (5, 1, "line5"), 28: (6, 1, "line6"), 29: (20, 3, "tetra20"), 30: (35, 3, "tetra35"), 31: (56, 3, "tetra56"),
    36: (16, 2, "quad16"), 37: (25, 2, "quad25"), 38: (36, 2, "quad36"), 92: (64, 3, "hexahedron64"),
    93: (125, 3, "hexahedron125"),
}  # fmt: skip
_CORNERS = {2: 3, 3: 4}
# What separates words, as one number on each line, which the fast parser takes; commas separate none here.
_ON_LINES, _COMMAS = bytes.maketrans(b" \t\r\v\f", b"\n" * 5), re.compile(rb"[,;]")
# Larger integers are no float64.
_LARGEST_EXACT = 1 << 53
# Rows of text that are first compared with the one before; longer words are no numbers.
_FEWEST_ALIKE, _LONGEST_WORD = 64, 64
# Parts of a mesh that has its groups in turns say nothing; names in a message.
_MOST_RUNS, _SHOWN = 1000, 10


class _Layout(NamedTuple):
    """How a version writes nodes and elements.

    Args:
        blocks: Whether they stand in blocks of one entity, each with a head; else a section begins with its count as a
            line of text.
        head: Numbers that head a section of blocks.
        entity_first: Whether a block's head is entity, dimension; else dimension, entity.
        tag: Type of tags; "size" is that of the file's sizes.
        tags_apart: Whether the tags of a block's nodes stand before all of its positions.
        boxed_points: Whether points among the entities have a box, not a position.
    """

    blocks: bool
    head: int = 0
    entity_first: bool = False
    tag: str = "i4"
    tags_apart: bool = False
    boxed_points: bool = False


_LAYOUTS = {
    "2": _Layout(blocks=False),
    "2.0": _Layout(blocks=False),
    "2.1": _Layout(blocks=False),
    "2.2": _Layout(blocks=False),
    # Gmsh itself writes 4.0 as 4.
    **dict.fromkeys(("4", "4.0"), _Layout(blocks=True, head=2, entity_first=True, boxed_points=True)),
    "4.1": _Layout(blocks=True, head=4, tag="size", tags_apart=True),
}


def is_gmsh(path: Path) -> bool:
    """Whether the file is Gmsh's, not Fluent's."""
    with open(path, "rb") as file:
        return file.read(64).lstrip().startswith(b"$")


def read_gmsh(path: Path) -> list[Body]:
    """Triangles and quads, with the arrays of nodes, elements and corners and the physical groups as ``physical``.

    Faces of named groups that stand together are groups of the body too.
    """
    content = _Content(path)
    nodes: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None
    elements: _Elements | None = None
    groups: dict[tuple[int, int], NDArray[np.int64]] = {}
    names: dict[int, str] = {}
    arrays: dict[tuple[str, str], list[_Array]] = {}
    unread: dict[str, None] = {}
    while name := content.next_section():
        if name in ("Nodes", "ParametricNodes"):
            nodes = _nodes(content, name == "ParametricNodes")
        elif name == "Elements":
            elements = _elements(content)
        elif name == "PhysicalNames":
            names = _names(content)
        elif name in ("Entities", "PartitionedEntities"):
            groups.update(_groups(content, name == "PartitionedEntities"))
        elif name in ("NodeData", "ElementData", "ElementNodeData"):
            array = _array(content, name == "ElementNodeData")
            arrays.setdefault((name, array.name), []).append(array)
        elif name == "InterpolationScheme":
            unread[name] = None
        content.end_section(name)
    if nodes is None or elements is None:
        raise FileFormatError(f"{path}: has no section {'Elements' if nodes else 'Nodes'}; get a whole copy")
    return [_body(path, *nodes, elements, groups, names, arrays, list(unread))]


# --- The text and the numbers -----------------------------------------------------------------------------------------


class _Content:
    """The file, and the place in it that is read next."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0
        self.is_text, self.order, self.word_at = True, "<", 0
        # Those of the rest of a section of text: as numbers if all are plain, else as words.
        self.plain: NDArray[np.float64] | None = None
        self.words: list[bytes] = []
        first = self.next_section()
        while first and first != "MeshFormat":
            if first == "NOD":
                raise FileFormatError(f"{path}: is of version 1 of .msh, which is not read; save it as 4.1 or 2.2")
            self.end_section(first)
            first = self.next_section()
        version, binary, size = ([*self.line().split(), b"", b"", b""])[:3]
        if version.decode("latin-1") not in _LAYOUTS or binary not in (b"0", b"1") or size not in (b"4", b"8"):
            raise FileFormatError(
                f"{path}: is of version {version.decode('latin-1')[:20]!r} of .msh, which is not read; save it as 4.1 "
                "or 2.2"
            )
        self.layout = _LAYOUTS[version.decode("latin-1")]
        self.kinds = {"i4": "i4", "f8": "f8", "size": f"u{size.decode()}", "long": "u8"}
        if self.layout.head == 2:
            self.kinds["size"] = "u8"
        if binary == b"1":
            one = self.data[self.at : self.at + 4]
            if one not in (b"\1\0\0\0", b"\0\0\0\1"):
                raise self.damaged("its order of bytes is not told")
            self.at, self.order = self.at + 4, "<" if one[0] else ">"
        self.is_text = binary == b"0"
        self.end_section("MeshFormat")

    def damaged(self, why: str) -> FileFormatError:
        return FileFormatError(f"{self.path}: {why}; the file is damaged, get a whole copy")

    def line(self) -> bytes:
        end = self.data.find(b"\n", self.at)
        if end < 0:
            raise self.damaged("ends within a section")
        found, self.at = self.data[self.at : end], end + 1
        return found.strip()

    def integer(self) -> int:
        """The integer of a line of text, which binary files have too."""
        line = self.line()
        try:
            return int(line)
        except ValueError:
            raise self.damaged(f"has {line[:20]!r} where a count belongs") from None

    def next_section(self) -> str:
        found = re.compile(rb"\s*\$(\w+)[ \t\r]*\n").match(self.data, self.at)
        if found is None:
            if self.data[self.at :].strip():
                raise self.damaged(f"has {self.data[self.at :].strip()[:20]!r} where a section begins")
            return ""
        self.at, self.words, self.plain = found.end(), [], None
        return found[1].decode()

    def end_section(self, name: str) -> None:
        end = re.compile(rb"\$(End|END)%s[ \t\r]*(\n|\Z)" % name.encode()).search(self.data, self.at)
        if end is None:
            raise self.damaged(f"ends within its section {name}")
        self.at, self.words, self.plain = end.end(), [], None

    def numbers(self, kind: str, count: int) -> NDArray[Any]:
        """The next numbers, as int64 or float64."""
        wide: Any = np.float64 if kind == "f8" else np.int64
        if count < 0:
            raise self.damaged(f"has a count of {count}")
        if self.is_text:
            if self.plain is None and not self.words:
                self._split()
            place = slice(self.word_at, self.word_at + count)
            values = None if self.plain is None else _as_kind(self.plain[place], wide)
            if values is None:
                self.words, self.plain = self.words or self._rest().split(), None
                values = self._parsed(self.words[place], wide)
            self.word_at += count
            if len(values) < count:
                raise self.damaged("ends within a section")
            return values
        dtype = np.dtype(self.order + self.kinds[kind])
        if count * dtype.itemsize > len(self.data) - self.at:
            raise self.damaged("ends within a section")
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += count * dtype.itemsize
        return values.astype(wide)

    def all_integers(self) -> NDArray[np.int64]:
        """Those of the rest of a section of text."""
        self._split()
        found = None if self.plain is None else _as_kind(self.plain, np.int64)
        return self._parsed(self.words or self._rest().split(), np.int64) if found is None else found

    def _split(self) -> None:
        rest = self._rest()
        # With a comma, one line would hold several.
        lines = b"" if _COMMAS.search(rest) else rest.translate(_ON_LINES)
        table = plain_rows(lines, 0, len(lines))
        self.plain = None if table is None else table.ravel()
        self.words, self.word_at = [] if table is not None else rest.split(), 0

    def _rest(self) -> bytes:
        end = self.data.find(b"$End", self.at)
        return self.data[self.at : end if end >= 0 else len(self.data)]

    def _parsed(self, words: list[bytes], wide: Any) -> NDArray[Any]:
        if not words:
            return np.empty(0, wide)
        try:
            if max(map(len, words)) > _LONGEST_WORD:
                raise ValueError(f"one of more than {_LONGEST_WORD} characters")
            return np.array(words, "S").astype(wide)
        except ValueError as error:
            raise self.damaged(f"has words among its numbers ({error})") from None

    def number(self, kind: str) -> int:
        return int(self.numbers(kind, 1)[0])

    def rows(self, count: int, *columns: tuple[str, int]) -> list[NDArray[Any]]:
        """Rows of numbers of several types, a table for each type."""
        width = sum(number for _, number in columns)
        if self.is_text:
            words, at, found = self.numbers("f8", count * width).reshape(count, width), 0, []
            for kind, number in columns:
                part = words[:, at : at + number]
                values = _as_kind(part, np.float64 if kind == "f8" else np.int64)
                if values is None:
                    raise self.damaged("has a number that is not whole, or is too large, where a tag belongs")
                found.append(values)
                at += number
            return found
        record = np.dtype(
            [(str(place), self.order + self.kinds[kind], (number,)) for place, (kind, number) in enumerate(columns)]
        )
        if count < 0 or count * record.itemsize > len(self.data) - self.at:
            raise self.damaged("ends within a section")
        table = np.frombuffer(self.data, record, count, self.at)
        self.at += count * record.itemsize
        return [
            table[str(place)].astype(np.float64 if kind == "f8" else np.int64)
            for place, (kind, _) in enumerate(columns)
        ]


def _as_kind(values: NDArray[np.float64], wide: Any) -> NDArray[Any] | None:
    """Numbers as integers, if that is the type; None if they are none, or none that float64 holds exactly."""
    if wide is np.float64:
        return values
    with np.errstate(invalid="ignore"):
        whole = values.astype(np.int64)
    is_exact = bool(((whole == values) & (np.abs(values) < _LARGEST_EXACT)).all())
    return whole if is_exact else None


# --- Sections ---------------------------------------------------------------------------------------------------------


def _blocks(content: _Content, read: Callable[[int, int, int, int], None]) -> None:
    """Call ``read(dimension, entity, third number, count)`` at each block of nodes or elements."""
    count = int(content.numbers("size", content.layout.head)[0])
    for _ in range(count):
        first, second, third = content.numbers("i4", 3).tolist()
        dimension, entity = (second, first) if content.layout.entity_first else (first, second)
        read(dimension, entity, third, content.number("size"))


def _nodes(content: _Content, parametric: bool) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Tags and positions."""
    layout = content.layout
    if not layout.blocks:
        count = content.integer()
        if parametric:
            raise FileFormatError(
                f"{content.path}: has nodes with parameters in version 2, which are not read; save it with "
                "Mesh.SaveParametric = 0"
            )
        tags, places = content.rows(count, ("i4", 1), ("f8", 3))
        return tags[:, 0], places
    found: list[tuple[NDArray[Any], NDArray[Any]]] = []

    def read(dimension: int, _: int, parameters: int, count: int) -> None:
        # Positions may be followed by those on their curve or surface.
        width = 3 + (dimension if parameters else 0)
        if layout.tags_apart:
            found.append((content.numbers(layout.tag, count), content.rows(count, ("f8", width))[0][:, :3]))
        else:
            tags, places = content.rows(count, (layout.tag, 1), ("f8", width))
            found.append((tags[:, 0], places[:, :3]))

    _blocks(content, read)
    return (
        np.concatenate([np.empty(0, np.int64), *(tags for tags, _ in found)]),
        np.concatenate([np.empty((0, 3)), *(places for _, places in found)]),
    )


class _Elements(NamedTuple):
    """All elements: tags, type and group of each, and the tags of their nodes one after the other."""

    tags: NDArray[np.int64]
    types: NDArray[np.int64]
    physical: NDArray[np.int64]
    entities: list[tuple[int, int, int]]  # dimension, entity, count; empty where elements tell their groups
    nodes: list[NDArray[np.int64]]


def _elements(content: _Content) -> _Elements:
    layout = content.layout
    tags: list[NDArray[Any]] = []
    types: list[NDArray[Any]] = []
    physical: list[NDArray[Any]] = []
    nodes: list[NDArray[Any]] = []
    entities: list[tuple[int, int, int]] = []

    def width(kind: int) -> int:
        if kind not in _TYPES:
            raise FileFormatError(
                f"{content.path}: has elements of Gmsh's type {kind}, which are not read; export first-order triangles "
                "or quads"
            )
        return _TYPES[kind][0]

    def add(rows: NDArray[Any], kind: int, others: int) -> None:
        tags.append(rows[:, 0])
        types.append(np.full(len(rows), kind))
        physical.append(rows[:, 1] if others else np.zeros(len(rows), np.int64))
        nodes.append(rows[:, 1 + others :])

    def read(dimension: int, entity: int, kind: int, count: int) -> None:
        add(content.numbers(layout.tag, count * (1 + width(kind))).reshape(count, -1), kind, 0)
        entities.append((dimension, entity, count))

    if layout.blocks:
        _blocks(content, read)
    elif content.is_text:
        _lines_of_elements(content, add, width)
    else:
        left = content.integer()
        while left > 0:
            kind, count, others = content.numbers("i4", 3).tolist()
            if count < 1 or others < 0:
                raise content.damaged(f"has a block of {count} elements")
            add(content.numbers("i4", count * (1 + others + width(kind))).reshape(count, -1), kind, others)
            left -= count
    empty = np.empty(0, np.int64)
    return _Elements(
        np.concatenate([empty, *tags]),
        np.concatenate([empty, *types]),
        np.concatenate([empty, *physical]),
        entities,
        nodes,
    )


def _lines_of_elements(
    content: _Content, add: Callable[[NDArray[Any], int, int], None], width: Callable[[int], int]
) -> None:
    """Elements of version 2 in ASCII, each with its type and a count of further numbers; those alike in one table."""
    left = content.integer()
    numbers = content.all_integers()
    at, most = 0, _FEWEST_ALIKE
    while left > 0:
        if at + 3 > len(numbers):
            raise content.damaged("ends within its elements")
        kind, others = int(numbers[at + 1]), int(numbers[at + 2])
        if others < 0:
            raise content.damaged(f"has an element with {others} tags")
        row = 3 + others + width(kind)
        # As many rows as have the same head.
        table = numbers[at : at + row * min(left, most, (len(numbers) - at) // row)].reshape(-1, row)
        if not len(table):
            raise content.damaged("ends within its elements")
        same = (table[:, 1] == kind) & (table[:, 2] == others)
        count = len(table) if same.all() else int(np.argmin(same))
        add(np.delete(table[:count], [1, 2], axis=1), kind, others)
        at, left = at + count * row, left - count
        most = 2 * most if count == len(table) else _FEWEST_ALIKE


def _groups(content: _Content, partitioned: bool) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Physical groups of each entity by dimension and tag."""
    found = {}
    if partitioned:
        content.number("size")
        content.numbers("i4", 2 * content.number("size"))
    for dimension, count in enumerate(content.numbers("size", 4).tolist()):
        for _ in range(count):
            tag = content.number("i4")
            if partitioned:
                content.numbers("i4", 2)
                content.numbers("i4", content.number("size"))
            content.numbers("f8", 6 if dimension or content.layout.boxed_points else 3)
            found[dimension, tag] = content.numbers("i4", content.number("size"))
            if dimension:
                content.numbers("i4", content.number("size"))
    return found


def _names(content: _Content) -> dict[int, str]:
    """Names of the physical groups of surfaces, which are text in binary files too."""
    found = {}
    for _ in range(content.integer()):
        line = content.line()
        match = re.match(rb"(\d+)\s+(-?\d+)\s+(.*)", line)
        if match is None:
            raise content.damaged(f"has {line[:40]!r} where the name of a group belongs")
        if int(match[1]) == 2:
            found[int(match[2])] = match[3].decode("utf-8", "replace").strip().strip('"')
    return found


class _Array(NamedTuple):
    """A section of data: tags, and a row for each; of corners a row for each node of each of the tags."""

    name: str
    step: int
    tags: NDArray[np.int64]
    counts: NDArray[np.int64] | None
    values: NDArray[np.float64]


def _array(content: _Content, of_corners: bool) -> _Array:
    labels = [content.line() for _ in range(content.integer())]
    for _ in range(content.integer()):
        content.line()
    numbers = [content.integer() for _ in range(content.integer())]
    if not labels or len(numbers) < 3 or numbers[1] < 1 or not 0 <= numbers[2] <= len(content.data):
        raise content.damaged("has data of no name or size")
    step, width, count = numbers[:3]
    name = labels[0].decode("utf-8", "replace").replace('"', "")
    counts = None
    if of_corners:
        parts = []
        heads = np.empty((count, 2), np.int64)
        for row in range(count):
            heads[row] = content.numbers("i4", 2)
            parts.append(content.numbers("f8", int(heads[row, 1]) * width))
        tags, counts = heads.T
        values = np.concatenate([np.empty(0), *parts]).reshape(-1, width)
    else:
        table, values = content.rows(count, ("i4", 1), ("f8", width))
        tags = table[:, 0]
    return _Array(name, step, tags, counts, values[:, 0] if width == 1 else values)


# --- The surface ------------------------------------------------------------------------------------------------------


def _body(
    path: Path,
    node_tags: NDArray[np.int64],
    places: NDArray[np.float64],
    elements: _Elements,
    groups: dict[tuple[int, int], NDArray[np.int64]],
    names: dict[int, str],
    arrays: dict[tuple[str, str], list[_Array]],
    unread: list[str],
) -> Body:
    sizes = np.array([_TYPES.get(kind, (0,))[0] for kind in range(max(_TYPES) + 1)])[elements.types]
    dimensions = np.array([_TYPES.get(kind, (0, 0))[1] for kind in range(max(_TYPES) + 1)])[elements.types]
    kinds, how_many = np.unique(elements.types, return_counts=True)
    listed = {_TYPES[kind][2]: count for kind, count in zip(kinds.tolist(), how_many, strict=True)}
    solid = ", ".join(f"{listed[_TYPES[kind][2]]} {_TYPES[kind][2]}" for kind in kinds.tolist() if _TYPES[kind][1] == 3)
    curved = [kind for kind in kinds.tolist() if _TYPES[kind][1] == 2 and kind not in _CORNERS]
    if curved:
        raise FileFormatError(
            f"{path}: holds '{_TYPES[curved[0]][2]}' cells, which are not polygons; export first-order triangles or "
            "quads"
        )
    faces = np.flatnonzero(dimensions == 2)
    if not len(faces):
        what = solid or f"{len(places)} points"
        raise FileFormatError(f"{path}: holds {what} but no surface cells; extract the surface and export that")
    notes = [f"its volume cells ({solid}) are left out"] if solid else []
    less = {"points": int((dimensions == 0).sum()), "lines": int((dimensions == 1).sum())}
    notes += [f"its {name} ({count}) are left out" for name, count in less.items() if count]
    notes += [f"its {name}, with the values that it is for, is left out" for name in unread]

    physical = elements.physical
    if elements.entities:
        of_entities = [groups.get((dimension, tag), np.empty(0, np.int64)) for dimension, tag, _ in elements.entities]
        counts = [count for _, _, count in elements.entities]
        physical = np.repeat([int(found[0]) if len(found) else 0 for found in of_entities], counts)
        several = np.repeat([len(found) > 1 for found in of_entities], counts)[faces].sum()
        if several:
            notes.append(f"{several} faces are of several physical groups, and the first is kept")
    parts_of, said = _runs(physical[faces], names)
    notes += said
    starts = np.concatenate([[0], np.cumsum(sizes)])
    tags = np.concatenate([np.empty(0, np.int64), *(rows.ravel() for rows in elements.nodes)])
    widths = sizes[faces]
    corners = np.repeat(starts[faces] - (np.cumsum(widths) - widths), widths) + np.arange(widths.sum())
    at = _Tags(node_tags, path, "nodes")
    indices = at.find(tags[corners])
    if (indices < 0).any():
        row = int(np.argmax(indices < 0))
        raise FileFormatError(
            f"{path}: an element has the node {tags[corners][row]}, which is not there; export it again"
        )

    data: dict[str, dict[str, NDArray[Any]]] = {"NodeData": {}, "ElementData": {}, "ElementNodeData": {}}
    if physical.any():
        data["ElementData"]["physical"] = physical[faces].astype(np.int32)
    for (kind, name), parts in arrays.items():
        steps = dict.fromkeys(part.step for part in parts)
        if len(steps) > 1:
            last = next(reversed(steps))
            notes.append(f"the array {name!r} has {len(steps)} time steps; the last ({last}) is kept")
            parts = [part for part in parts if part.step == last]
        rows = _Tags(elements.tags, path, "elements") if kind != "NodeData" else at
        places_of, values = [], []
        for part in parts:
            found = rows.find(part.tags)
            if kind == "ElementNodeData":
                found = _corner_rows(found, part, sizes, starts)
            places_of.append(found)
            values.append(part.values)
        where, table = np.concatenate(places_of), np.concatenate(values)
        if (where < 0).any():
            notes.append(f"the array {name!r} is left out: it has values for tags that are not there")
            continue
        target = {"NodeData": len(node_tags), "ElementData": len(sizes), "ElementNodeData": int(starts[-1])}[kind]
        whole, has = np.full((target, *table.shape[1:]), np.nan), np.zeros(target, bool)
        whole[where], has[where] = table, True
        chosen = {"NodeData": np.arange(target), "ElementData": faces, "ElementNodeData": corners}[kind]
        if has[chosen].any():
            data[kind][name] = whole[chosen]
        else:
            notes.append(f"the array {name!r} is left out: it has no values on the surface")
    vertex, polygon, corner = (from_columns(found) for found in data.values())
    return Body(
        places,
        widths,
        indices,
        groups=parts_of,
        vertex_data=vertex,
        polygon_data=polygon,
        corner_data=corner,
        notes=tuple(notes),
    )


def _runs(physical: NDArray[np.int64], names: dict[int, str]) -> tuple[tuple[tuple[str, int, int], ...], list[str]]:
    """(name, first, count) of faces of one group that stand together, and a note where the names are left out."""
    if not any(names.get(number) for number in np.unique(physical).tolist()):
        return (), []
    first = np.flatnonzero(np.diff(physical, prepend=physical[0] - 1))
    if len(first) == 1:
        return (), []
    if len(first) > _MOST_RUNS:
        listed = ", ".join(f"{number} {name!r}" for number, name in sorted(names.items())[:_SHOWN])
        return (), [f"the names of its physical groups are left out, for their faces alternate: {listed}"]
    counts = np.diff(first, append=len(physical)).tolist()
    numbers = physical[first].tolist()
    # Faces of no group are a part without a name.
    labels = [names.get(number) or (str(number) if number else "") for number in numbers]
    return tuple(zip(labels, first.tolist(), counts, strict=True)), []


class _Tags:
    """Rows by tag."""

    def __init__(self, tags: NDArray[np.int64], path: Path, what: str) -> None:
        self.order = np.argsort(tags, kind="stable")
        self.tags = tags[self.order]
        repeated = np.flatnonzero(self.tags[1:] == self.tags[:-1])
        if len(repeated):
            raise FileFormatError(f"{path}: two of its {what} have the tag {self.tags[repeated[0]]}; export it again")

    def find(self, tags: NDArray[np.int64]) -> NDArray[np.int64]:
        """Row of each tag, -1 where there is none."""
        if not len(self.tags):
            return np.full(len(tags), -1)
        at = np.minimum(np.searchsorted(self.tags, tags), len(self.tags) - 1)
        return np.where(self.tags[at] == tags, self.order[at], -1)


def _corner_rows(
    found: NDArray[np.int64], part: _Array, sizes: NDArray[np.int64], starts: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Where each row of an array of corners belongs, -1 where the element is not there or has other corners."""
    assert part.counts is not None
    known = (found >= 0) & (sizes[found] == part.counts)
    first = np.where(known, starts[found], -1)
    within = np.arange(part.counts.sum()) - np.repeat(np.cumsum(part.counts) - part.counts, part.counts)
    begin = np.repeat(first, part.counts)
    return np.where(begin < 0, -1, begin + within)
