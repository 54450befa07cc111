"""Wavefront .obj: vertices, polygons and named groups, in float64."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.body import Body
from geokit.formats.columns import Columns
from geokit.formats.text import numbers, point_lines

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "read_points", "write_mesh"]


class _Lines(NamedTuple):
    """Lines of a file by kind, without their first word; the number of vertices above each face; starts of groups."""

    vertices: list[bytes]
    faces: list[bytes]
    vertices_before: list[int]
    starts: list[tuple[str, int]]


def _lines(data: bytes) -> _Lines:
    data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    vertices: list[bytes] = []
    faces: list[bytes] = []
    vertices_before: list[int] = []
    starts: list[tuple[str, int]] = []
    # splitlines also splits at form feeds and other bytes that text may contain; OBJ lines end at newlines only.
    for line in data.replace(b"\r", b"\n").replace(b"\t", b" ").split(b"\n"):
        kind, _, rest = line.strip().partition(b" ")
        if kind == b"v":
            vertices.append(rest)
        elif kind in (b"f", b"fo"):
            faces.append(rest)
            vertices_before.append(len(vertices))
        elif kind in (b"o", b"g"):
            starts.append((rest.strip().decode("utf-8", "replace"), len(faces)))
    return _Lines(vertices, faces, vertices_before, starts)


def _coordinates(lines: list[bytes], path: Path) -> NDArray[np.float64]:
    return numbers(_first_three(lines, path), np.float64, path, "vertices").reshape(-1, 3)


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the vertices; everything else is left out.

    Raises:
        FileFormatError: A vertex is not three numbers; the message names its line.
    """
    data = path.read_bytes()
    try:
        return _coordinates(_lines(data).vertices, path), {}
    except FileFormatError:
        _blame(data, path)
        raise


def _blame(data: bytes, path: Path) -> None:
    """Raise the error for the first vertex that is not three numbers."""
    for number, line in enumerate(data.splitlines(), 1):
        words = line.split()
        if not words or words[0] != b"v":
            continue
        try:
            _, _, _ = map(float, words[1:4])
        except ValueError:
            shown = line[:60].decode("ascii", "backslashreplace")
            raise FileFormatError(f"{path}: line {number} ('{shown}') is not a vertex; the file is damaged") from None


def read_mesh(path: Path) -> list[Body]:
    """Read an .obj file; its ``o`` and ``g`` lines become groups.

    Texture coordinates, normals, materials and lines are left out; free-form curves and surfaces have no polygons.
    """
    data = path.read_bytes()
    vertices, faces, vertices_before, starts = _lines(data)
    coordinates = _coordinates(vertices, path)
    if b"/" in data or b"#" in data:
        faces = _AFTER_INDEX.sub(b"", b"\n".join(faces)).split(b"\n") if faces else []
    counts, corners = _split(faces)
    indices = numbers(corners, np.int64, path, "face indices")
    zero = np.flatnonzero(indices == 0)
    if len(zero):
        row = int(np.searchsorted(np.cumsum(counts), zero[0], side="right"))
        raise FileFormatError(f"{path}: face {row} uses vertex 0, but .obj indices start at 1; the file is damaged")
    # Negative indices count back from the last vertex above their line.
    before = np.repeat(np.asarray(vertices_before, np.int64), counts)
    indices = np.where(indices > 0, indices - 1, indices + before)
    return [Body(coordinates, counts, indices, groups=_groups(starts, len(faces)))]


# Texture and normal of a corner, or a comment at the end of a line.
_AFTER_INDEX = re.compile(rb"/[^ \n]*|#[^\n]*")


def _first_three(lines: list[bytes], path: Path) -> list[bytes]:
    """The first three tokens of each line; a weight or a color may follow."""
    counts, tokens = _split(lines)
    if np.all(counts == 3):
        return tokens
    rows = [line.split()[:3] for line in lines]
    for row, found in enumerate(rows):
        if len(found) < 3:
            raise FileFormatError(f"{path}: vertex {row} has {len(found)} coordinates, not three; the file is damaged")
    return [token for found in rows for token in found]


def _split(lines: list[bytes]) -> tuple[NDArray[np.int64], list[bytes]]:
    """Count of the tokens in each line, and all tokens in one list."""
    tokens = b" ".join(lines).split()
    # Two single spaces in each line and three tokens a line on average mean three tokens in each. Splitting line by
    # line takes three times as long, mostly for making the lists.
    if len(tokens) == 3 * len(lines) and all(line.count(b" ") == 2 for line in lines):
        return np.full(len(lines), 3, np.int64), tokens
    return np.fromiter((len(line.split()) for line in lines), np.int64, len(lines)), tokens


def _groups(starts: list[tuple[str, int]], face_count: int) -> tuple[tuple[str, int, int], ...]:
    """(name, first, count) of the groups that hold faces; empty if the file names fewer than two."""
    bounds = [first for _, first in starts] + [face_count]
    groups = [(name, first, end - first) for (name, first), end in zip(starts, bounds[1:], strict=True) if end > first]
    if groups and bounds[0] > 0:
        groups.insert(0, ("", 0, bounds[0]))
    return tuple(groups) if len(groups) > 1 else ()


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write text that reads back as the same float64 vertices; parts become ``o`` groups."""
    # A group's name ends at the end of its line, so it must not contain a newline.
    names = {part.first_face: " ".join(part.name.split()) or "part" for part in mesh.parts if part.face_count}
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        if not names:
            file.write(f"o {' '.join(mesh.name.split()) or 'mesh'}\n")
        file.writelines(point_lines(mesh.vertices, "v "))
        for row, (a, b, c) in enumerate((mesh.faces + 1).tolist()):
            if row in names:
                file.write(f"o {names[row]}\n")
            file.write(f"f {a} {b} {c}\n")
