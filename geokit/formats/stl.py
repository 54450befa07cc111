"""Stereolithography .stl, binary and ASCII: separate triangles whose exactly equal corners become one vertex."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_points
from geokit.core.files import damaged
from geokit.errors import FileFormatError
from geokit.formats.file_content.body import Body
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.words import numbers

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

HEADER_BYTES = 84
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID = re.compile(rb"^[ \t]*(endsolid|solid)\b[ \t]*([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
# Other ways to write the parts of a solid.
_COLOR = re.compile(rb"^[ \t]*colou?r\b[^\n]*$", re.MULTILINE | re.IGNORECASE)
_END = re.compile(rb"(?<=\s)end[ \t]*solid\b", re.IGNORECASE)
_FACET = re.compile(rb"(?<=[ \t])facet(?=\s+normal\b)", re.IGNORECASE)
_FACET_WORDS = [b"facet", b"normal", None, None, None, b"outer", b"loop"]
_FACET_WORDS += [b"vertex", None, None, None] * 3 + [b"endloop", b"endfacet"]


def read_mesh(path: Path) -> list[Body]:
    """Read an .stl file; the solids of an ASCII file become groups. Normals and attributes are left out, colors
    with a note.

    A warning names bytes behind the last triangle of a binary file, and a solid whose end is missing.
    """
    data = path.read_bytes()
    count = binary_count(data[:HEADER_BYTES], len(data))
    if count is not None:
        records = np.frombuffer(data, RECORD, count, HEADER_BYTES)
        notes = left_behind(len(data), count)
        # VisCAM marks colors by their highest bit, Magics by the header.
        colors = records["attribute"]
        if (colors >> 15).any() or (b"COLOR=" in data[:80] and colors.any()):
            notes += ("the colors of its faces are left out",)
        return [_weld(records["corners"].astype(np.float64).reshape(-1, 3), (), notes)]
    text = plain_text(data, path)
    if text.lstrip()[:5].lower() == b"solid":
        return [_read_ascii(text, path)]
    declared = int.from_bytes(data[80:84], "little") if len(data) >= HEADER_BYTES else -1
    if declared < 0:
        raise FileFormatError(f"{path}: {len(data)} bytes are too few for an .stl file; get a whole copy")
    raise FileFormatError(
        f"{path}: declares {declared} triangles ({HEADER_BYTES + declared * RECORD.itemsize} bytes) but is "
        f"{len(data)} bytes long; it is truncated or damaged, get a whole copy"
    )


def binary_count(head: bytes, size: int) -> int | None:
    """Number of triangles of a binary file, from its first 84 bytes and its size; None if it is none, or damaged.

    Bytes may follow the last triangle, but no whole number of further triangles: then the count is wrong.
    """
    declared = int.from_bytes(head[80:84], "little") if len(head) >= HEADER_BYTES else -1
    behind = size - HEADER_BYTES - declared * RECORD.itemsize
    # Some binary headers start with "solid" too, so a size that matches the count exactly decides.
    if declared < 0 or behind < 0:
        return None
    return declared if behind == 0 or (declared and behind % RECORD.itemsize) else None


def left_behind(size: int, count: int) -> tuple[str, ...]:
    """What to say about bytes behind the last of so many triangles."""
    behind = size - HEADER_BYTES - count * RECORD.itemsize
    return (f"{behind} bytes behind the last of its {count} triangles are left out",) if behind else ()


def _read_ascii(data: bytes, path: Path) -> Body:
    notes: list[str] = []
    try:
        solids = _solids(data, path)
    except FileFormatError:
        # Nearly all files are written as the format says, and are read without a look at each line.
        data = _as_usual(data, notes)
        solids = _solids(data, path)
    points, groups, first = [], [], 0
    for name, corners in solids:
        groups.append((name, first, len(corners) // 3))
        points.append(corners)
        first += len(corners) // 3
    return _weld(np.concatenate(points), tuple(groups) if len(groups) > 1 else (), tuple(notes))


def _solids(data: bytes, path: Path) -> list[tuple[str, NDArray[np.float64]]]:
    """Names of the solids and corners (3 T, 3) of their facets."""
    solids, opened = [], None
    for line in _SOLID.finditer(data):
        ends = line[1].lower() == b"endsolid"
        if ends == (opened is None):
            break
        if opened is None:
            opened = line
            continue
        name = opened[2].strip().decode("utf-8", "replace")
        solids.append((name, _facets(data[opened.end() : line.start()], path)))
        opened = None
    if opened is not None or not solids:
        raise FileFormatError(f"{path}: a solid has no 'endsolid'; the file is truncated or damaged, get a whole copy")
    return solids


def _as_usual(data: bytes, notes: list[str]) -> bytes:
    """The text with each solid's name and end on lines of their own, and without lines of colors."""
    data = _COLOR.sub(b"", data)
    data = _END.sub(b"\nendsolid", data)
    data = _FACET.sub(b"\nfacet", data)
    pieces, end, opened = [], 0, False
    for line in _SOLID.finditer(data):
        if line[1].lower() == b"endsolid":
            opened = False
            continue
        if opened:
            notes.append("a solid has no 'endsolid' before the next one begins")
            pieces += [data[end : line.start()], b"\nendsolid\n"]
            end = line.start()
        opened = True
    pieces.append(data[end:])
    # What is cut off within a facet stays damaged.
    if opened and data.rstrip().lower().endswith(b"endfacet"):
        notes.append("the last solid has no 'endsolid'; if facets are missing, get a whole copy")
        pieces.append(b"\nendsolid\n")
    return b"".join(pieces)


def _facets(text: bytes, path: Path) -> NDArray[np.float64]:
    """Corners (3 T, 3) of a solid's facets."""
    tokens = text.split()
    stride = len(_FACET_WORDS)
    whole = len(tokens) % stride == 0
    for at, word in enumerate(_FACET_WORDS):
        if word is not None and whole:
            whole = all(token == word or token.lower() == word for token in tokens[at::stride])
    if not whole:
        raise damaged(path, "a solid holds something else than facets of three vertices")
    columns = [tokens[at + axis :: stride] for at in (8, 12, 16) for axis in range(3)]
    table = [numbers(column, np.float64, path, "vertices") for column in columns]
    return np.stack(table, axis=1).reshape(-1, 3)


def _weld(corners: NDArray[np.float64], groups: tuple[tuple[str, int, int], ...], notes: tuple[str, ...] = ()) -> Body:
    first, group = merge_equal_points(corners)
    return Body(corners[first], np.full(len(corners) // 3, 3), group, groups=groups, notes=notes)


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a binary file, float32, with the triangles' unit normals (zero if a triangle has no area)."""
    corners = mesh.vertices[mesh.faces]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(len(corners), RECORD)
    records["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
    records["corners"] = corners
    with open(path, "wb") as file:
        # The header must not start with "solid", or readers would take the file for ASCII.
        file.write(b"binary STL by geokit".ljust(80, b" ") + len(records).to_bytes(4, "little"))
        file.write(records.tobytes())
