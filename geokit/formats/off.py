"""Object File Format (.off), ASCII: vertices and polygons, in float64."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError
from geokit.formats.file_content.body import Body
from geokit.formats.text_files.decimal import plain_rows, written_lines
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.words import numbers
from geokit.mesh.model.data import full_scale

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Texture coordinates, colors and normals in Geomview's order, or in that of MeshLab.
_HEADER = re.compile(rb"\s*((?:ST)?C?N?|NC?(?:ST)?|CST)OFF(?![A-Za-z])(?!\s*BINARY)", re.IGNORECASE)
# Counts without a word before them, as the first of a file's lines.
_COUNTS = re.compile(rb"\s*()(?=\d+[ \t]+\d+(?:[ \t]+\d+)?[ \t]*\n)")


def read_mesh(path: Path) -> list[Body]:
    """Read an ASCII .off file (OFF, COFF, NOFF, STOFF and combinations of them), with the colors of faces."""
    data = plain_text(path.read_bytes(), path)
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    header = _HEADER.match(data) or _bare_counts(data)
    if header is None:
        raise FileFormatError(
            f"{path}: does not start with OFF, COFF, NOFF or STOFF as ASCII .off files of three dimensions do; "
            "export it as such"
        )
    lines = [line for line in data[header.end() :].split(b"\n") if line.strip()]
    sizes = numbers(lines[0].split() if lines else [], np.int64, path, "counts")
    if len(sizes) < 2 or sizes[:2].min() < 0:
        raise FileFormatError(f"{path}: the line of vertex and face counts is missing; the file is damaged")
    vertex_count, face_count = int(sizes[0]), int(sizes[1])
    if len(lines) - 1 < vertex_count + face_count:
        raise FileFormatError(
            f"{path}: declares {vertex_count} vertices and {face_count} faces but holds {len(lines) - 1} lines; "
            "it is truncated, get a whole copy"
        )
    first = lines[1 : 1 + vertex_count]
    points = None if header[1] else _table(first, b"0123456789.+-eE \n")
    notes: list[str] = []
    vertex: dict[str, NDArray[Any]] = {}
    if points is None or points.shape[1] != 3:
        whole = [line.split() for line in first]
        for at, row in enumerate(whole):
            if len(row) < 3:
                raise FileFormatError(f"{path}: vertex {at} has {len(row)} coordinates, not three; the file is damaged")
        points = numbers([token for row in whole for token in row[:3]], np.float64, path, "vertices")
        if header[1] or any(len(row) > 3 for row in whole):
            vertex = _vertex_data(whole, header, path, notes)
    counts, indices, colors = _polygons(lines[1 + vertex_count :], face_count, path)
    polygon = {}
    if colors:
        widths = {len(color) for color in colors}
        if len(colors) == len(counts) and len(widths) == 1 and widths < {3, 4}:
            polygon = {"color": _colors(colors, path)}
        else:
            notes.append("the colors of faces are left out: not each face has one of 3 or 4 numbers")
    body = Body(points.reshape(-1, 3), counts, indices, vertex_data=vertex, polygon_data=polygon, notes=tuple(notes))
    return [body]


def _bare_counts(data: bytes) -> re.Match[bytes] | None:
    """The place of the counts in a file without a first word; None if its other lines are not as many as they say."""
    found = _COUNTS.match(data)
    if found is None:
        return None
    first, *lines = [line for line in data[found.end() :].split(b"\n") if line.strip()]
    vertices, faces, *_ = map(int, first.split())
    return found if vertices and faces and len(lines) == vertices + faces else None


def _vertex_data(
    rows: list[list[bytes]], header: re.Match[bytes], path: Path, notes: list[str]
) -> dict[str, NDArray[Any]]:
    """What stands behind the positions: normals, colors, texture coordinates, as the header says."""
    said = header[1].upper()
    has_uv, has_color, has_normal = (letters in said for letters in (b"ST", b"C", b"N"))
    widths = {len(row) for row in rows}
    colored = max(widths, default=0) - 3 - 3 * has_normal - 2 * has_uv
    if len(widths) > 1 or colored not in ((3, 4) if has_color else (0,)):
        if rows:
            notes.append("the attributes of vertices are left out: their lines are not as long as the header says")
        return {}
    data: dict[str, NDArray[Any]] = {}
    # MeshLab names normals first, and writes colors first.
    if has_normal:
        first = 3 + colored * said.startswith(b"NC")
        data["normal"] = _floats([row[first : first + 3] for row in rows], path)
    if has_color:
        first = 3 + 3 * (has_normal and not said.startswith(b"NC"))
        data["color"] = _colors([row[first : first + colored] for row in rows], path)
    if has_uv:
        data["uv"] = _floats([row[-2:] for row in rows], path)
    return data


def _floats(rows: list[list[bytes]], path: Path) -> NDArray[np.float64]:
    return numbers([token for row in rows for token in row], np.float64, path, "attributes").reshape(len(rows), -1)


def _colors(rows: list[list[bytes]], path: Path) -> NDArray[Any]:
    """Colors as uint8 if all are whole numbers up to 255, else as floats."""
    values = _floats(rows, path)
    whole = all(token.isdigit() for row in rows for token in row) and values.max(initial=0.0) <= 255.0
    return values.astype(np.uint8) if whole else values


def _table(lines: list[bytes], signs: bytes) -> NDArray[np.float64] | None:
    """Lines of equally many numbers, in no other signs, if they are many."""
    text = b"\n".join(lines)
    return None if text.translate(None, signs) else plain_rows(text, 0, len(text))


def _polygons(
    lines: list[bytes], count: int, path: Path
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[list[bytes]]]:
    """Corner counts and corners of the first ``count`` faces, and what stands behind the corners of those with more.

    Raises:
        FileFormatError: The lines end early or are not integers.
    """
    # Nearly all files have one polygon size and no colors.
    table = _table(lines[:count], b"0123456789 \n")
    if table is not None and np.all(table[:, 0] == table.shape[1] - 1):
        return table[:, 0].astype(np.int64), table[:, 1:].ravel().astype(np.int64), []
    counts, corners, colors = np.empty(count, np.int64), [], []
    rest = iter(lines)
    for row in range(count):
        tokens = next(rest, b"").split()
        counts[row] = size = int(numbers(tokens[:1] or [b"-1"], np.int64, path, "face sizes")[0])
        # The corners of a face may stand on several lines.
        while len(tokens) <= size and (more := next(rest, None)):
            tokens += more.split()
        if not 0 <= size < len(tokens):
            raise FileFormatError(
                f"{path}: the file ends in face {row} of the {count} it declares; it is truncated, get a whole copy"
            )
        corners += tokens[1 : 1 + size]
        # A face's color follows its corners.
        if len(tokens) > 1 + size:
            colors.append(tokens[1 + size :])
    return counts, numbers(corners, np.int64, path, "face indices"), colors


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write text that reads back as the same float64 vertices; colors of 8 bits as whole numbers, others as floats."""
    data = {name: mesh.vertex_data[name] for name in ("normal", "color", "uv") if name in mesh.vertex_data}
    kind = "ST" * ("uv" in data) + "C" * ("color" in data) + "N" * ("normal" in data)
    vertex = [mesh.vertices, *(_written(values) for values in data.values())]
    face = [mesh.faces, *(_written(mesh.face_data[name]) for name in ("color",) if name in mesh.face_data)]
    with open(path, "wb") as file:
        file.write(f"{kind}OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode("ascii"))
        file.writelines(written_lines(*vertex))
        file.writelines(written_lines(*face, prefix="3 "))


def _written(values: NDArray[Any]) -> NDArray[Any]:
    # Whole numbers mean colors up to 255.
    return values / full_scale(values.dtype) if values.dtype.kind in "iu" and values.dtype != np.uint8 else values
