"""Arrays of Gmsh's .msh files in ASCII, each row with the tag of its node or element.

meshio takes their rows in the order of the file's nodes and elements, which need not be that of the tags.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["read_gmsh"]

_SECTION = rb"^\$%s[ \t\r]*\n(.*?)^\$End%s\b[^\n]*\n?"
_ARRAYS = re.compile(_SECTION % (rb"(NodeData|ElementData)", rb"\1"), re.DOTALL | re.MULTILINE)
_FORMAT = re.compile(rb"^\$MeshFormat\s+([\d.]+)\s+([01])\s+(\d+)", re.MULTILINE)


def read_gmsh(path: Path, meshio: Any) -> tuple[Any, list[str]]:
    """meshio's mesh with each row of an array at its node or element, NaN where it has none, and notes.

    Raises:
        ValueError: The file is damaged.
    """
    content = path.read_bytes()
    told = _FORMAT.search(content)
    if told is None or not _ARRAYS.search(content):
        return meshio.gmsh.read(path), []
    if told[2] == b"1":
        mesh = meshio.gmsh.read(path)
        if told[1].startswith(b"2"):  # whose nodes meshio takes in order only
            return mesh, _with_cells_of_binary(mesh, content, 0, old=True, second=True)
        if told[1] not in (b"4", b"4.0", b"4.1") or told[3] != b"8":
            return mesh, []
        return _of_binary(mesh, content, old=told[1] == b"4.0")
    sections = {name: _section(content, name) for name in (b"Nodes", b"Elements")}
    with tempfile.TemporaryFile() as file:
        file.write(_ARRAYS.sub(b"", content))
        file.seek(0)
        mesh = meshio.gmsh.main.read_buffer(file)
    old = told[1].startswith(b"2") or told[1] == b"4.0"
    tags = {
        b"NodeData": _tags_of_lines(sections[b"Nodes"], told[1]) if old else _tags_of_nodes(sections[b"Nodes"]),
        b"ElementData": _tags_of_lines(sections[b"Elements"], told[1] if old else b"4.1"),
    }
    notes = []
    ends = np.cumsum([len(block.data) for block in mesh.cells])[:-1]
    for kind, text in _ARRAYS.findall(content):
        name, rows, values = _array(text)
        placed = _placed(rows, values, tags[kind])
        if placed is None:
            notes.append(f"the array {name!r} is left out: it has values for tags that are not there")
        elif kind == b"NodeData":
            mesh.point_data[name] = placed
        else:
            mesh.cell_data[name] = np.split(placed, ends)
    return mesh, notes


def _of_binary(mesh: Any, content: bytes, *, old: bool) -> tuple[Any, list[str]]:
    """The mesh with its arrays in the order of the file's nodes and elements.

    meshio reads only arrays with the tags 1, 2, 3, ..., and takes nodes and elements to stand in their order.

    Args:
        mesh: What meshio reads.
        content: The file.
        old: Whether it is of version 4.0, whose tags are shorter and stand beside the coordinates.
    """
    node = np.dtype([("tag", "<i4"), ("place", "<f8", 3)])
    at = content.find(b"$Nodes\n") + len(b"$Nodes\n")
    block_count, tags = int(np.frombuffer(content, "<u8", 1, at)[0]), []
    at += (2 if old else 4) * 8
    for _ in range(block_count):
        count = int(np.frombuffer(content, "<u8", 1, at + 12)[0])
        tags.append(
            np.frombuffer(content, node, count, at + 20)["tag"]
            if old
            else np.frombuffer(content, "<u8", count, at + 20)
        )
        at += 20 + (node.itemsize if old else (1 + 3) * 8) * count
    order, notes = _order(tags), []
    for name, values in list(mesh.point_data.items()):
        if name.startswith("gmsh:"):
            continue
        if order.max(initial=-1) < len(values):
            mesh.point_data[name] = values[order]
        else:
            del mesh.point_data[name]
            notes.append(f"the array {name!r} is left out: its rows are not those of the nodes")
    return mesh, notes + _with_cells_of_binary(mesh, content, at, old=old)


def _with_cells_of_binary(mesh: Any, content: bytes, start: int, *, old: bool, second: bool = False) -> list[str]:
    """Bring the arrays of elements into the order of these; notes on those that are left out.

    Args:
        mesh: What meshio reads, which is changed.
        content: The file.
        start: Where its nodes end.
        old: Whether it is of version 4.0 or 2, with tags of 32 bits.
        second: Whether it is of version 2.
    """
    told = [name for name in mesh.cell_data if not name.startswith("gmsh:")]
    if not told:
        return []
    at = content.find(b"$Elements\n", start) + len(b"$Elements\n")
    tags, kind, notes = [], np.dtype("<i4" if old else "<u8"), []
    at = content.find(b"\n", at) + 1 if second else at + (2 if old else 4) * 8
    for block in mesh.cells:
        left, width = len(block.data), 1 + block.data.shape[1]
        while left > 0:
            # Blocks of version 2 may hold one element each, and further numbers before its nodes.
            more = np.frombuffer(content, "<i4", 2, at + 4) if second else (left, 0)
            count, row = int(more[0]), width + int(more[1])
            if count < 1 or row < width:
                raise ValueError("a block of no elements")
            at += 12 if second else 20
            tags.append(np.frombuffer(content, kind, count * row, at)[::row])
            at, left = at + count * row * kind.itemsize, left - count
    order, ends = _order(tags), np.cumsum([len(block.data) for block in mesh.cells])[:-1]
    for name in told:
        values = np.concatenate(mesh.cell_data[name])
        if np.array_equal(np.sort(order), np.arange(len(values))):
            mesh.cell_data[name] = np.split(values[order], ends)
        else:
            del mesh.cell_data[name]
            notes.append(f"the array {name!r} is left out: its rows are not those of the elements")
    return notes


def _order(tags: list[NDArray[Any]]) -> NDArray[np.int64]:
    """The row of each tag, in blocks of them, in arrays that have a row for each tag from 1."""
    return np.concatenate([np.empty(0, np.int64), *(block.astype(np.int64) - 1 for block in tags)])


def _section(content: bytes, name: bytes) -> bytes:
    found = re.search(_SECTION % (name, name), content, re.DOTALL | re.MULTILINE)
    if found is None:
        raise ValueError(f"has no section {name.decode()}")
    return found[1]


def _tags_of_nodes(section: bytes) -> NDArray[np.int64]:
    """Tags of the nodes of version 4.1: those of a block stand before its positions."""
    words = section.split()
    found, at = [], 4
    for _ in range(int(words[0])):
        count = int(words[at + 3])
        found.append(np.array(words[at + 4 : at + 4 + count], np.int64))
        at += 4 + 4 * count
    return np.concatenate([np.empty(0, np.int64), *found])


def _tags_of_lines(section: bytes, version: bytes) -> NDArray[np.int64]:
    """The first number of each line, without those that head the section and, from version 4 on, its blocks."""
    lines = section.split(b"\n")[1:]
    lines = [line for line in lines if line.strip()]
    if version.startswith(b"2"):
        return np.array([line.split(None, 1)[0] for line in lines], np.int64)
    found, at = [], 0
    while at < len(lines):
        count = int(lines[at].split()[3])
        found += [line.split(None, 1)[0] for line in lines[at + 1 : at + 1 + count]]
        at += 1 + count
    return np.array(found, np.int64)


def _array(text: bytes) -> tuple[str, NDArray[np.int64], NDArray[np.float64]]:
    """Name, tags and values of a section of data."""
    lines = iter(text.split(b"\n"))
    labels = [next(lines) for _ in range(int(next(lines)))]
    for _ in range(int(next(lines))):
        next(lines)
    numbers = [int(next(lines)) for _ in range(int(next(lines)))]
    width, count = numbers[1], numbers[2]
    table = np.array(b" ".join(lines).split(), np.float64).reshape(count, 1 + width)
    values = table[:, 1] if width == 1 else table[:, 1:]
    return labels[0].decode("utf-8", "replace").strip().replace('"', ""), table[:, 0].astype(np.int64), values


def _placed(
    rows: NDArray[np.int64], values: NDArray[np.float64], tags: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Values in the order of the tags, NaN where there is none; None if they belong to other tags."""
    order = np.argsort(tags, kind="stable")
    at = np.searchsorted(tags[order], rows)
    if len(rows) and (at.max() >= len(tags) or not np.array_equal(tags[order][at], rows)):
        return None
    found = np.full((len(tags), *values.shape[1:]), np.nan)
    found[order[at]] = values
    return found
