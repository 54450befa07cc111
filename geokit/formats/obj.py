"""Wavefront .obj: vertices, polygons and named groups, in float64."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.errors import FileFormatError
from geokit.formats.attributes import mtl
from geokit.formats.columns import Columns
from geokit.formats.file_content.body import Body, FileMaterial
from geokit.formats.text_files.decimal import written_lines, written_rows
from geokit.formats.text_files.plain import plain_text
from geokit.formats.text_files.words import as_number, numbers
from geokit.mesh.attributes.seams import distinct_corners
from geokit.mesh.model.data import full_scale

if TYPE_CHECKING:
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# .mtl has no alpha cutoff.
HOLDS_CUTOFFS = False
# What faces without a material name in files that name one for others.
_NO_MATERIAL = "(null)"


class _Lines(NamedTuple):
    """Lines of a file by kind, without their first word; the number of vertices above each face.

    Of groups and materials (``usemtl``): the name and the number of faces above it. ``libraries`` are the ``mtllib``.
    """

    vertices: list[bytes]
    faces: list[bytes]
    vertices_before: list[int]
    starts: list[tuple[str, int]]
    uv: list[bytes]
    normal: list[bytes]
    materials: list[tuple[str, int]]
    libraries: list[str]
    unknown: list[bytes]
    others: Counter[bytes]


# Elements without faces, and what they are called.
_OTHERS = {
    b"l": "lines",
    b"p": "points",
    b"curv": "free-form curves",
    b"surf": "free-form surfaces",
    b"call": "called files",
}
# Words that begin lines of which nothing is read: such elements, shading, parts of free-form curves and surfaces.
_LEFT_OUT = frozenset(
    b"p l s mg vp cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con bevel c_interp d_interp lod "
    b"maplib usemap shadow_obj trace_obj ctech stech csh bsp bzp cdc cdp res".split()
)
_READ = frozenset((b"v", b"f", b"fo", b"vt", b"vn", b"o", b"g", b"usemtl", b"mtllib"))
# These words at the start of a line, in any case.
_KEYWORD = re.compile(rb"^[ \t\f\v]*(?:v|f|fo|vt|vn|o|g|usemtl|mtllib)(?=[ \t\r\n]|$)", re.IGNORECASE | re.MULTILINE)
# A backslash at the end of a comment, such as that of a Windows folder, which continues no line.
_COMMENT_END = re.compile(rb"(#[^\r\n]*?)\\+(?=\r?\n)")
# A vertex or face whose first number has no blank before it that is known as one.
_JOINED = re.compile(rb"(?:v|vt|vn|f|fo)[^a-z_#]", re.IGNORECASE)


def _text(path: Path) -> bytes:
    data = plain_text(path.read_bytes(), path)
    return _COMMENT_END.sub(rb"\1", data) if b"\\" in data and b"#" in data else data


def _lines(data: bytes) -> _Lines:
    data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    found = _Lines([], [], [], [], [], [], [], [], [], Counter())
    vertices, faces, vertices_before, starts, uv, normal, materials, libraries, unknown, others = found
    # splitlines also splits at form feeds and other bytes that text may contain; OBJ lines end at newlines only.
    for line in data.replace(b"\r", b"\n").replace(b"\t", b" ").split(b"\n"):
        kind, _, rest = line.strip().partition(b" ")
        if kind == b"v":
            vertices.append(rest)
        elif kind in (b"f", b"fo"):
            faces.append(rest)
            vertices_before.append(len(vertices))
        elif kind == b"vt":
            uv.append(rest)
        elif kind == b"vn":
            normal.append(rest)
        elif kind in (b"o", b"g"):
            starts.append((rest.strip().decode("utf-8", "replace"), len(faces)))
        elif kind == b"usemtl":
            materials.append((rest.strip().decode("utf-8", "replace"), len(faces)))
        elif kind == b"mtllib":
            libraries.append(rest.strip().decode("utf-8", "replace"))
        elif kind in _OTHERS:
            others[kind] += 1
        elif kind and kind not in _LEFT_OUT and not kind.startswith(b"#"):
            if kind.lower() in _READ:
                return _lines(_KEYWORD.sub(lambda word: word[0].lower(), data))
            if kind.lower() not in _LEFT_OUT:
                unknown.append(line)
    return found


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read the vertices, and the colors behind them as ``rgb``; everything else is left out.

    Raises:
        FileFormatError: A vertex is not three numbers; the message names its line.
    """
    data = _text(path)
    lines = _lines(data)
    notes = _unknown(lines.unknown, data, path)
    try:
        points, colors = _vertices(lines.vertices, path, notes)
    except FileFormatError:
        _blame(data, path)
        raise
    for note in notes:
        warn(f"{path}: {note}")
    return points, {} if colors is None else {"rgb": colors}


def _unknown(lines: list[bytes], data: bytes, path: Path) -> list[str]:
    """What to say about lines that begin with a word that is not known.

    Raises:
        FileFormatError: One is a vertex or a face whose numbers are not apart from its first word.
    """
    if not lines:
        return []
    joined = next(filter(_JOINED.match, map(bytes.strip, lines)), None)
    for number, line in _numbered(data):
        if joined is not None and line.strip() == joined:
            raise FileFormatError(
                f"{path}: line {number} ({_shown(line)!r}) begins with no known word; write a blank behind 'v' or 'f'"
            )
        if joined is None and line.strip() == lines[0].strip():
            word = _shown(line).split()[0]
            count = "a line begins" if len(lines) == 1 else f"{len(lines)} lines begin"
            first = "line" if len(lines) == 1 else "the first is line"
            return [f"{count} with words that .obj does not know and are left out: {first} {number}, {word!r}"]
    return []


def _shown(line: bytes) -> str:
    return line[:60].decode("utf-8", "backslashreplace").strip()


def _numbered(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, those that are continued with those that continue them, as :func:`_lines` has them."""
    begun, first = b"", 0
    for number, line in enumerate(data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n"), 1):
        first = first or number
        if line.endswith(b"\\"):
            begun += line[:-1] + b" "
            continue
        yield first, (begun + line).replace(b"\t", b" ")
        begun, first = b"", 0
    if first:
        yield first, begun.replace(b"\t", b" ")


def _blame(data: bytes, path: Path) -> None:
    """Raise the error for the first vertex that is not three numbers."""
    row = -1
    for number, line in _numbered(data):
        words = line.split()
        if not words or words[0].lower() != b"v":
            continue
        row += 1
        wrong = next((word for word in words[1:4] if as_number(word.decode("ascii", "replace")) is None), None)
        if wrong is None and len(words) >= 4:
            continue
        if wrong is not None:
            why = f"{_shown(wrong)!r} is not a number"
        else:
            why = f"vertex {row} has {len(words) - 1} coordinates, not three"
        raise FileFormatError(f"{path}: line {number} ({_shown(line)!r}) is not a vertex: {why}; the file is damaged")


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read an .obj file; its ``o`` and ``g`` lines become groups.

    Texture coordinates and normals are on corners, NaN where a corner has none. Colors behind the positions are on
    vertices. Materials come from the libraries and images that the file names, if they lie in its folder or in
    ``folders``. Lines, points, and free-form curves and surfaces are left out, with a note.
    """
    data = _text(path)
    lines = _lines(data)
    faces, notes = lines.faces, _unknown(lines.unknown, data, path)
    if faces and lines.others:
        listed = ", ".join(f"{name} ({lines.others[kind]})" for kind, name in _OTHERS.items() if lines.others[kind])
        notes.append(f"its {listed} are left out")
    try:
        coordinates, colors = _vertices(lines.vertices, path, notes)
    except FileFormatError:
        _blame(data, path)
        raise
    if b"#" in data:
        faces = _COMMENT.sub(b"", b"\n".join(faces)).split(b"\n") if faces else []
    counts, corners = _split(faces)
    corner: dict[str, NDArray[Any]] = {}
    if b"/" in data:
        corners, references = _references(corners)
        for name, tokens, rows, kind in (
            ("uv", references[0], lines.uv, b"vt"),
            ("normal", references[1], lines.normal, b"vn"),
        ):
            try:
                values = _referred(tokens, rows, 2 if name == "uv" else 3, counts, data, kind, path)
            except FileFormatError as error:
                notes.append(f"{name!r} is left out: {str(error).removeprefix(f'{path}: ')}")
                continue
            if values is not None:
                corner[name] = values
    indices = numbers(corners, np.int64, path, "face indices")
    zero = np.flatnonzero(indices == 0)
    if len(zero):
        row = int(np.searchsorted(np.cumsum(counts), zero[0], side="right"))
        raise FileFormatError(f"{path}: face {row} uses vertex 0, but .obj indices start at 1; the file is damaged")
    # Negative indices count back from the last vertex above their line.
    before = np.repeat(np.asarray(lines.vertices_before, np.int64), counts)
    indices = np.where(indices > 0, indices - 1, indices + before)
    polygon, materials = _materials(lines, len(faces), path, folders, notes)
    return [
        Body(
            coordinates,
            counts,
            indices,
            groups=_groups(lines.starts, len(faces)),
            vertex_data={} if colors is None else {"color": colors},
            polygon_data=polygon,
            corner_data=corner,
            materials=materials,
            notes=tuple(notes),
        )
    ]


_COMMENT = re.compile(rb"#[^\n]*")


def _vertices(lines: list[bytes], path: Path, notes: list[str]) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """Positions, and the colors behind them if each vertex has one."""
    counts, tokens = _split(lines)
    if np.any(counts > 3) and any(b"#" in line for line in lines):
        lines = [line.partition(b"#")[0] for line in lines]
        counts, tokens = _split(lines)
    if np.all(counts == 3):
        return numbers(tokens, np.float64, path, "vertices").reshape(-1, 3), None
    if np.all(counts == 6):
        table = numbers(tokens, np.float64, path, "vertices").reshape(-1, 6)
        colors = np.ascontiguousarray(table[:, 3:])
        # Colors are full at 1, but some programs write bytes.
        if len(colors) and colors.max() > 1.0 and np.array_equal(colors, np.clip(np.rint(colors), 0.0, 255.0)):
            return np.ascontiguousarray(table[:, :3]), colors.astype(np.uint8)
        return np.ascontiguousarray(table[:, :3]), colors
    if np.any(counts > 4):
        notes.append(
            "the numbers behind the coordinates of vertices are left out: not each vertex has a color of three"
        )
    return numbers(_first_three(lines, path), np.float64, path, "vertices").reshape(-1, 3), None


def _references(corners: list[bytes]) -> tuple[list[bytes], tuple[list[bytes], list[bytes]]]:
    """The vertices of corners, and their texture coordinates and normals; b"" where a corner has none."""
    slashes = {corner.count(b"/") for corner in corners}
    # Nearly always all corners are written alike, which is several times faster than one by one.
    if len(slashes) == 1 and (width := slashes.pop() + 1) <= 3 and not any(corner.endswith(b"/") for corner in corners):
        text = b" ".join(corners)
        skipped = text.count(b"//")
        tokens = text.replace(b"//" if skipped else b"/", b" ").split()
        if skipped in (0, len(corners)) and len(tokens) == len(corners) * (2 if skipped else width):
            step = 2 if skipped else width
            columns = [tokens[at::step] for at in range(step)] + [[], []]
            return (columns[0], ([], columns[1])) if skipped else (columns[0], (columns[1], columns[2]))
    parts = [([*corner.split(b"/"), b"", b""])[:3] for corner in corners]
    return [part[0] for part in parts], ([part[1] for part in parts], [part[2] for part in parts])


def _referred(
    references: list[bytes],
    lines: list[bytes],
    width: int,
    counts: NDArray[np.int64],
    data: bytes,
    kind: bytes,
    path: Path,
) -> NDArray[np.float64] | None:
    """Values of corners, (C, width); None if no corner refers to one.

    Raises:
        FileFormatError: A value or a reference is no number, or a reference leads nowhere.
    """
    rows = numbers([reference or b"0" for reference in references], np.int64, path, f"references to {kind.decode()}")
    if not rows.any():
        return None
    if rows.min() < 0:
        above = np.repeat(_count_above(data, kind), counts)
        rows = np.where(rows < 0, rows + above + 1, rows)
    bad = (rows < 0) | (rows > len(lines))
    if bad.any():
        corner = int(np.argmax(bad))
        raise FileFormatError(
            f"{path}: corner {corner} refers to number {rows[corner]} of {len(lines)} {kind.decode()}"
        )
    sizes, tokens = _split(lines)
    if np.any(sizes < width):
        raise FileFormatError(f"{path}: row {np.argmax(sizes < width)} of {kind.decode()} has too few numbers")
    if np.any(sizes != width):
        tokens = [token for line in lines for token in line.split()[:width]]
    values = numbers(tokens, np.float64, path, kind.decode()).reshape(-1, width)
    return np.concatenate([np.full((1, width), np.nan), values])[rows]


def _count_above(data: bytes, kind: bytes) -> NDArray[np.int64]:
    """The number of lines of a kind above each face."""
    above, count = [], 0
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n").split(b"\n"):
        word = [first.lower() for first in line.split(None, 1)[:1]]
        count += word == [kind]
        if word in ([b"f"], [b"fo"]):
            above.append(count)
    return np.asarray(above, np.int64)


def _materials(
    lines: _Lines, face_count: int, path: Path, folders: Sequence[Path], notes: list[str]
) -> tuple[dict[str, NDArray[np.int32]], tuple[FileMaterial, ...]]:
    """The material of each polygon, and the materials in the order in which they are used first."""
    used = [(name, first) for name, first in lines.materials if first < face_count]
    names = [name for name in dict.fromkeys(name for name, _ in used) if name not in ("", _NO_MATERIAL)]
    if not names:
        return {}, ()
    known = mtl.read_libraries(lines.libraries, set(names), path, folders, notes)
    numbers_of = {name: number for number, name in enumerate(names)}
    rows = np.full(face_count, -1, np.int32)
    for (name, first), (_, end) in zip(used, [*used[1:], ("", face_count)], strict=True):
        rows[first:end] = numbers_of.get(name, -1)
    return {"material": rows}, tuple(known.get(name, FileMaterial(name)) for name in names)


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


def companions(mesh: TriangleMesh, path: Path) -> dict[str, bytes]:
    """The material library and the images beside a file."""
    return mtl.write_library(mesh.materials, path.stem)


def companions_of(path: Path) -> set[str]:
    """Names of the material libraries that a file names, and of their images."""
    names: set[str] = set()
    with open(path, "rb") as file:
        for line in iter(lambda: file.readline(1 << 16), b""):
            word, _, rest = line.strip().partition(b" ")
            if word.lower() == b"mtllib":
                listed = rest.strip().decode("utf-8", "replace")
                names.update((listed, *listed.split()))
    return names.union(*(mtl.image_names(path.parent / name) for name in names))


def write_mesh(path: Path, mesh: TriangleMesh, stem: str = "mesh") -> None:
    """Write text that reads back as the same float64 vertices; parts become ``o`` groups.

    Args:
        path: The file to write.
        mesh: The mesh.
        stem: The file's final name without its extension, for the name of the material library.
    """
    # A group's name ends at the end of its line, so it must not contain a newline.
    names = {part.first_face: " ".join(part.name.split()) or "part" for part in mesh.parts if part.face_count}
    above = {row: f"o {name}\n" for row, name in names.items()}
    for row, material in _material_lines(mesh):
        above[row] = above.get(row, "") + f"usemtl {material}\n"
    tables = {kind: _table(mesh, name) for kind, name in (("vt", "uv"), ("vn", "normal"))}
    # Names of files that are no UTF-8 become names of meshes.
    with open(path, "wb") as file:
        head = f"mtllib {mtl.library_name(stem)}\n" if mesh.materials else ""
        head += "" if names else f"o {' '.join(mesh.name.split()) or 'mesh'}\n"
        file.write(head.encode("utf-8", "replace"))
        colors = [mesh.vertex_data[name] for name in ("color",) if name in mesh.vertex_data]
        file.writelines(written_lines(mesh.vertices, *(each / full_scale(each.dtype) for each in colors), prefix="v "))
        for kind, (rows, _) in tables.items():
            file.writelines(written_lines(rows, prefix=f"{kind} "))
        faces = _face_lines(mesh.faces + 1, tables["vt"][1], tables["vn"][1])
        if above:
            faces = b"".join(faces).splitlines(keepends=True)
            for row, text in above.items():
                faces[row] = text.encode("utf-8", "replace") + faces[row]
        file.writelines(faces)


def _material_lines(mesh: TriangleMesh) -> Iterator[tuple[int, str]]:
    """The rows of faces from which another material is used, and its name."""
    if not mesh.materials:
        return
    names = [*mtl.plain_names(mesh.materials), _NO_MATERIAL]
    rows = mesh.face_data.get("material", np.full(len(mesh.faces), -1))
    for row in np.flatnonzero(np.append(rows[0] >= 0, rows[1:] != rows[:-1])):
        yield int(row), names[rows[row]]


def _table(mesh: TriangleMesh, name: str) -> tuple[NDArray[Any], NDArray[np.int64] | None]:
    """Rows of an attribute, and the row of each corner (F, 3), from 1; 0 where it has none, and None if none has."""
    if name in mesh.corner_data:
        first, group = distinct_corners(None, {name: mesh.corner_data[name]})
        rows, at = mesh.corner_data[name].reshape(3 * len(mesh.faces), -1)[first], group.reshape(-1, 3) + 1
    elif name in mesh.vertex_data:
        rows, at = mesh.vertex_data[name], mesh.faces.astype(np.int64) + 1
    else:
        return np.empty((0, 3)), None
    missing = np.append(False, np.isnan(rows).all(axis=1))
    return np.nan_to_num(rows, posinf=np.inf, neginf=-np.inf) if missing.any() else rows, np.where(missing[at], 0, at)


def _face_lines(vertex: NDArray[Any], uv: NDArray[np.int64] | None, normal: NDArray[np.int64] | None) -> list[bytes]:
    columns = [table for table in (vertex, uv, normal) if table is not None]
    corner = "{}//{}" if uv is None and normal is not None else "/".join(["{}"] * len(columns))
    lines = written_rows(f"f {corner} {corner} {corner}\n", np.stack(columns, axis=2).reshape(len(vertex), -1))
    if all(table.all() for table in columns):
        return lines
    return [_END.sub(b"", _NONE.sub(b"/", part)) for part in lines]


# A row that is none, and slashes that then end a corner.
_NONE, _END = re.compile(rb"/0\b"), re.compile(rb"/+(?=[ \n])")
