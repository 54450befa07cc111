"""Stereolithography .stl, binary and ASCII: separate triangles whose exactly equal corners become one vertex."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geokit.core.equal_rows import merge_equal_points
from geokit.errors import FileFormatError
from geokit.formats.body import Body
from geokit.formats.text import numbers

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["HEADER_BYTES", "RECORD", "read_mesh", "write_mesh"]

HEADER_BYTES = 84
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SOLID = re.compile(rb"^[ \t]*(endsolid|solid)\b[ \t]*([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
_FACET_WORDS = [b"facet", b"normal", None, None, None, b"outer", b"loop"]
_FACET_WORDS += [b"vertex", None, None, None] * 3 + [b"endloop", b"endfacet"]


def read_mesh(path: Path) -> list[Body]:
    """Read an .stl file; the solids of an ASCII file become groups. Normals and attributes are left out."""
    data = path.read_bytes()
    declared = int.from_bytes(data[80:84], "little") if len(data) >= HEADER_BYTES else -1
    # Some binary headers start with "solid" too, so a size that matches the count exactly decides.
    if declared >= 0 and len(data) == HEADER_BYTES + declared * RECORD.itemsize:
        records = np.frombuffer(data, RECORD, offset=HEADER_BYTES)
        return [_weld(records["corners"].astype(np.float64).reshape(-1, 3), ())]
    if data.lstrip()[:5].lower() == b"solid":
        return [_read_ascii(data, path)]
    if declared < 0:
        raise FileFormatError(f"{path}: {len(data)} bytes are too few for an .stl file; get a whole copy")
    raise FileFormatError(
        f"{path}: declares {declared} triangles ({HEADER_BYTES + declared * RECORD.itemsize} bytes) but is "
        f"{len(data)} bytes long; it is truncated or damaged, get a whole copy"
    )


def _read_ascii(data: bytes, path: Path) -> Body:
    points, groups, opened = [], [], None
    first = 0
    for line in _SOLID.finditer(data):
        ends = line[1].lower() == b"endsolid"
        if ends == (opened is None):
            break
        if opened is None:
            opened = line
            continue
        corners = _facets(data[opened.end() : line.start()], path)
        groups.append((opened[2].strip().decode("utf-8", "replace"), first, len(corners) // 3))
        points.append(corners)
        first += len(corners) // 3
        opened = None
    if opened is not None or not groups:
        raise FileFormatError(f"{path}: a solid has no 'endsolid'; the file is truncated or damaged, get a whole copy")
    return _weld(np.concatenate(points), tuple(groups) if len(groups) > 1 else ())


def _facets(text: bytes, path: Path) -> NDArray[np.float64]:
    """Corners (3 T, 3) of a solid's facets."""
    tokens = text.split()
    stride = len(_FACET_WORDS)
    whole = len(tokens) % stride == 0
    for at, word in enumerate(_FACET_WORDS):
        if word is not None and whole:
            whole = all(token == word or token.lower() == word for token in tokens[at::stride])
    if not whole:
        raise FileFormatError(
            f"{path}: a solid holds something else than facets of three vertices; the file is damaged, export it again"
        )
    columns = [tokens[at + axis :: stride] for at in (8, 12, 16) for axis in range(3)]
    table = [numbers(column, np.float64, path, "vertices") for column in columns]
    return np.stack(table, axis=1).reshape(-1, 3)


def _weld(corners: NDArray[np.float64], groups: tuple[tuple[str, int, int], ...]) -> Body:
    first, group = merge_equal_points(corners)
    return Body(corners[first], np.full(len(corners) // 3, 3), group, groups=groups)


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
