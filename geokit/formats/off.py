"""Object File Format (.off), ASCII: vertices and polygons, in float64."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.body import Body
from geokit.formats.text import numbers, point_lines

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "write_mesh"]

_HEADER = re.compile(rb"\s*(?:ST)?C?N?OFF\b(?!\s*BINARY)")


def read_mesh(path: Path) -> list[Body]:
    """Read an ASCII .off file (OFF, COFF, NOFF, STOFF and combinations of them); colors and normals are left out."""
    data = path.read_bytes()
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    header = _HEADER.match(data)
    if header is None:
        raise FileFormatError(
            f"{path}: does not start with OFF, COFF, NOFF or STOFF as ASCII .off files of three dimensions do; "
            "export it as such"
        )
    lines = [line for line in data[header.end() :].replace(b"\r", b"\n").split(b"\n") if line.strip()]
    sizes = numbers(lines[0].split() if lines else [], np.int64, path, "counts")
    if len(sizes) < 2 or sizes[:2].min() < 0:
        raise FileFormatError(f"{path}: the line of vertex and face counts is missing; the file is damaged")
    vertex_count, face_count = int(sizes[0]), int(sizes[1])
    if len(lines) - 1 < vertex_count + face_count:
        raise FileFormatError(
            f"{path}: declares {vertex_count} vertices and {face_count} faces but holds {len(lines) - 1} lines; "
            "it is truncated, get a whole copy"
        )
    rows = [line.split()[:3] for line in lines[1 : 1 + vertex_count]]
    if any(len(row) < 3 for row in rows):
        row = next(at for at, tokens in enumerate(rows) if len(tokens) < 3)
        raise FileFormatError(f"{path}: vertex {row} has {len(rows[row])} coordinates, not three; the file is damaged")
    points = numbers([token for row_tokens in rows for token in row_tokens], np.float64, path, "vertices")
    tokens: list[bytes] = []
    for line in lines[1 + vertex_count : 1 + vertex_count + face_count]:
        # A face's color follows its corners.
        row_tokens = line.split()
        tokens += row_tokens[: int(row_tokens[0]) + 1] if row_tokens[0].isdigit() else row_tokens
    counts, indices, used = _polygons(tokens, face_count, path)
    if used != len(tokens):
        raise FileFormatError(f"{path}: a face line holds fewer corners than it declares; the file is damaged")
    return [Body(points.reshape(-1, 3), counts, indices)]


def _polygons(tokens: list[bytes], count: int, path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Parse ``count`` runs of ``n i1 .. in`` from the start of ``tokens``: corner counts, indices, and tokens used.

    Raises:
        FileFormatError: The tokens end early or are not integers.
    """
    uniform = _uniform_polygons(tokens, count, path)
    if uniform is not None:
        return uniform
    counts = np.empty(count, np.int64)
    corners: list[bytes] = []
    at = 0
    for row in range(count):
        size = int(numbers(tokens[at : at + 1], np.int64, path, "face sizes")[0]) if at < len(tokens) else -1
        if size < 0 or at + 1 + size > len(tokens):
            raise FileFormatError(
                f"{path}: the file ends in face {row} of the {count} it declares; it is truncated, get a whole copy"
            )
        counts[row] = size
        corners += tokens[at + 1 : at + 1 + size]
        at += 1 + size
    return counts, numbers(corners, np.int64, path, "face indices"), at


def _uniform_polygons(tokens: list[bytes], count: int, path: Path) -> tuple[Any, Any, int] | None:
    # Nearly all files have one polygon size. Reading them as one table is thirty times as fast as polygon by polygon.
    if count == 0 or not tokens or not tokens[0].isdigit():
        return None
    size = int(tokens[0])
    used = count * (size + 1)
    if used > len(tokens) or any(token != tokens[0] for token in tokens[0 : used : size + 1]):
        return None
    table = numbers(tokens[:used], np.int64, path, "faces").reshape(count, size + 1)
    return table[:, 0], table[:, 1:].ravel(), used


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write text that reads back as the same float64 vertices."""
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n")
        file.writelines(point_lines(mesh.vertices))
        file.writelines(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces.tolist())
