"""Point cloud data (.pcd) of the Point Cloud Library: ASCII, binary, and binary with LZF compression.

LZF is read and written in C++; in Python, which is slow, if geokit was built without a compiler. A control byte below
32 announces that many literals plus one. Any other control byte is a back reference: its upper three bits are the
length minus two (for 7 the next byte is added), its lower five bits and the next byte the distance minus one.
"""

from __future__ import annotations

import codecs
import io
import mmap
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.files import in_one_line
from geokit.errors import FileFormatError, InputError
from geokit.formats.columns import Columns, integer_colors, joined
from geokit.formats.text_files.plain import plain_text, without_mark
from geokit.formats.text_files.rows import read_rows

ENCODINGS = ("ascii", "binary", "binary_compressed")
_KEYS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {"F": ("f4", "f8"), "I": ("i1", "i2", "i4", "i8"), "U": ("u1", "u2", "u4", "u8")}
_LONG = ("i8", "u8")
# The line that ends a header before binary content. Headers end within this.
_BINARY, _HEAD_BYTES = re.compile(rb"[\r\n]\s*DATA\s+binary", re.IGNORECASE), 1 << 16
# A field with this name is padding.
_PADDING = "_"
_AXES = ("x", "y", "z")
_COLORS = ("rgb", "rgba")
# PCL's names of the components of normals, and those that the rest of geokit uses.
_NORMALS = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}
# LZF expands three bytes to 264 at best: larger declared sizes are damage, detected before memory is allocated.
LZF_BEST = 88
# The format stores both sizes of a compressed body in 32 bits.
LZF_LIMIT = 2**32 - 1
# A record of more bytes than this cannot be a point; NumPy counts them in 31 bits.
LARGEST_RECORD = 2**30

# Each 32 literals cost one more byte, and the last run may be short.
LITERAL_RUN = 32
LONGEST_MATCH = 264
LARGEST_DISTANCE = 8192
# Size of the compressor's hash table, which stores positions by the hash of the three bytes there.
TABLE_BITS = 15


@dataclass
class _Field:
    name: str
    type: str
    count: int

    @property
    def width(self) -> int:
        return int(self.type[1:]) * self.count


@dataclass
class _Header:
    fields: list[_Field]
    count: int
    encoding: str
    start: int


def content_bytes(path: Path) -> int | None:
    """Size of the decompressed body, at most what LZF can make of the file; None if it is not compressed.

    Raises:
        FileFormatError: The header is damaged.
    """
    if path.stat().st_size == 0:
        return None
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if not _BINARY.search(data[:_HEAD_BYTES]):
            return None
        header = _read_header(data, path)
        if header.encoding != "binary_compressed" or len(data) < header.start + 8:
            return None
        return min(int(struct.unpack_from("<II", data, header.start)[1]), LZF_BEST * len(data))


def read_points(path: Path) -> tuple[NDArray[np.float64], Columns]:
    """Read points and columns by name, each in the type of the file; fields with a count above one are (N, count).

    Raises:
        FileFormatError: The file is damaged or truncated, or its header and body disagree.
    """
    data = path.read_bytes()
    # A mark before binary content is no part of it.
    data = without_mark(data) if _BINARY.search(data[:_HEAD_BYTES]) else plain_text(data, path)
    header = _read_header(data, path)
    if header.encoding == "ascii":
        parts = _ascii(data, header, path)
    elif header.encoding == "binary":
        parts = _binary(data, header, path)
    else:
        parts = _compressed(data, header, path)
    columns: Columns = {}
    for field, values in zip(header.fields, parts, strict=True):
        if field.name == _PADDING:
            continue
        if field.name in _COLORS and values.ndim == 1 and values.dtype.itemsize == 4:
            # Blue, green, red and alpha from the lowest byte up, whatever type the header declares.
            bytes_ = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).view(np.uint8).reshape(-1, 4)
            values = bytes_[:, [2, 1, 0, 3][: len(field.name)]]
        columns[_NORMALS.get(field.name, field.name)] = values
    return joined(columns, path)


def _read_header(data: bytes | mmap.mmap, path: Path) -> _Header:
    lines: dict[str, list[str]] = {}
    at = 0 if data[:3] != codecs.BOM_UTF8 else 3
    while "DATA" not in lines:
        end = data.find(b"\n", at)
        if end < 0:
            raise FileFormatError(f"{path}: the header has no DATA line; the file is truncated or not a .pcd file")
        line = data[at:end].decode("latin-1").strip()
        words = line.split()
        if words and not line.startswith("#"):
            words[0] = words[0].upper()
            if words[0] not in _KEYS or words[0] in lines:
                raise FileFormatError(
                    f"{path}: header line {line[:60]!r} (byte {at}) is not understood; "
                    "the file is damaged or not a .pcd file"
                )
            lines[words[0]] = words[1:]
        at = end + 1
    encoding = " ".join(lines["DATA"]).lower()
    if encoding not in ENCODINGS:
        raise FileFormatError(f"{path}: DATA is {encoding[:40]!r}; it needs to be one of {', '.join(ENCODINGS)}")
    return _Header(_fields(lines, path), _count(lines, path), encoding, at)


def _fields(lines: dict[str, list[str]], path: Path) -> list[_Field]:
    names = lines.get("FIELDS") or lines.get("COLUMNS") or []
    sizes, types = lines.get("SIZE", ["4"] * len(names)), lines.get("TYPE", ["F"] * len(names))
    counts = lines.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise FileFormatError(
            f"{path}: FIELDS, SIZE, TYPE and COUNT list {len(names)}, {len(sizes)}, {len(types)} and {len(counts)} "
            "entries; they need one for each field"
        )
    fields: list[_Field] = []
    taken: set[str] = set()
    for name, size, letter, count in zip(names, sizes, types, counts, strict=True):
        kind = letter.lower() + size
        if kind not in _TYPES.get(letter, ()) or not _is_count(count) or not 0 < int(count) < LARGEST_RECORD:
            given = in_one_line(f"TYPE {letter[:20]}, SIZE {size[:20]} and COUNT {count[:20]}")
            raise FileFormatError(
                f"{path}: field {name!r} has {given}, which the format does not know; the file is damaged"
            )
        if name != _PADDING and name in taken:
            raise FileFormatError(f"{path}: two fields are called {name!r}; give each its own name")
        if name.lower() in _AXES and int(count) != 1:
            raise FileFormatError(f"{path}: field {name!r} has COUNT {count}; a coordinate needs to be one number")
        taken.add(name)
        fields.append(_Field(name, kind, int(count)))
    if sum(field.width for field in fields) > LARGEST_RECORD:
        raise FileFormatError(f"{path}: its fields make a point of more than 1 GiB; the header is damaged")
    return fields


def _count(lines: dict[str, list[str]], path: Path) -> int:
    found = {key: " ".join(lines[key]) for key in ("POINTS", "WIDTH", "HEIGHT") if key in lines}
    for key, text in found.items():
        if not _is_count(text):
            raise FileFormatError(f"{path}: {key} is {text[:40]!r}, not a whole number; the file is damaged")
    grid = int(found["WIDTH"]) * int(found.get("HEIGHT", "1")) if "WIDTH" in found else None
    count = int(found["POINTS"]) if "POINTS" in found else grid
    if count is None or (grid is not None and grid != count):
        raise FileFormatError(
            f"{path}: POINTS is {found.get('POINTS', 'missing')} and WIDTH x HEIGHT is "
            f"{'missing' if grid is None else grid}; correct the header"
        )
    return count


def _is_count(text: str) -> bool:
    # Numbers of up to eighteen digits stay below 2^63.
    return text.isascii() and text.isdecimal() and len(text) <= 18


def _ascii(data: bytes, header: _Header, path: Path) -> list[NDArray[np.generic]]:
    width = sum(field.count for field in header.fields)
    body = data[header.start :]
    table = read_rows(data, header.start, path) if body.strip() else np.empty((0, width))
    if len(table) != header.count:
        end = f"ends in point {len(table)} of" if len(table) < header.count else f"has {len(table)} points and not"
        raise FileFormatError(f"{path}: {end} the {header.count} it declares; get a whole copy or correct POINTS")
    if table.shape[1] != width:
        raise FileFormatError(
            f"{path}: its rows have {table.shape[1]} values and its fields need {width}; correct the header"
        )
    # float64 cannot represent all 64-bit integers.
    long = any(field.type in _LONG for field in header.fields)
    tokens = np.array(body.split()) if long else np.empty(0)
    parts: list[NDArray[np.generic]] = []
    at = 0
    for field in header.fields:
        columns = slice(at, at + field.count) if field.count > 1 else at
        exact = None
        if field.type in _LONG and tokens.size == table.size:
            exact = _exact(tokens.reshape(table.shape)[:, columns], field.type)
        parts.append(_cast(table[:, columns], field, path) if exact is None else exact)
        at += field.count
    return parts


def _exact(words: NDArray[Any], kind: str) -> NDArray[np.generic] | None:
    """The words as integers; None if one is not an integer or is too large."""
    try:
        return np.array([int(word) for word in words.ravel()], kind).reshape(words.shape)
    except (ValueError, OverflowError):
        return None


def _cast(values: NDArray[np.float64], field: _Field, path: Path) -> NDArray[np.generic]:
    dtype = np.dtype(field.type)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    # Compared as floats, 2^63 - 1 equals 2^63, so only smaller values fit.
    bad = ~((values >= float(limits.min)) & (values < float(limits.max) + 1.0) & (np.floor(values) == values))
    if bad.any():
        row = int(np.argmax(bad.reshape(len(values), -1).any(axis=1)))
        raise FileFormatError(
            f"{path}: {field.name!r} of point {row} is not an integer of {8 * dtype.itemsize} bits; correct it"
        )
    return values.astype(dtype)


def _binary(data: bytes, header: _Header, path: Path) -> list[NDArray[np.generic]]:
    record = sum(field.width for field in header.fields)
    have = (len(data) - header.start) // record
    if have < header.count:
        raise FileFormatError(f"{path}: ends in point {have} of the {header.count} it declares; get a whole copy")
    table = np.frombuffer(data, _record_type(header.fields), header.count, header.start)
    return [table[f"f{at}"].astype(field.type) for at, field in enumerate(header.fields)]


def _record_type(fields: Sequence[_Field]) -> np.dtype[np.void]:
    # Fields are numbered, because padding fields share a name.
    parts = [("<" + field.type, (field.count,) if field.count > 1 else ()) for field in fields]
    return np.dtype([(f"f{at}", kind, shape) for at, (kind, shape) in enumerate(parts)])


def _compressed(data: bytes, header: _Header, path: Path) -> list[NDArray[np.generic]]:
    from geokit.formats.pcd import decompress

    if len(data) < header.start + 8:
        raise FileFormatError(f"{path}: ends before the sizes of its compressed body; get a whole copy")
    packed, size = struct.unpack_from("<II", data, header.start)
    body = header.start + 8
    if packed > len(data) - body:
        raise FileFormatError(
            f"{path}: ends after {len(data) - body} of the {packed} bytes of its compressed body; get a whole copy"
        )
    # PCL leaves padding out of a compressed body; other programs do not.
    widths = [0 if field.name == _PADDING else field.width for field in header.fields]
    if sum(widths) * header.count != size:
        widths = [field.width for field in header.fields]
    if sum(widths) * header.count != size or size > LZF_BEST * packed:
        raise FileFormatError(
            f"{path}: {packed} compressed bytes declare {size}, and {header.count} points have "
            f"{sum(widths) * header.count}; the file is damaged, get a whole copy"
        )
    plain, bad = decompress(np.frombuffer(data, np.uint8, packed, body), size)
    if bad >= 0:
        raise FileFormatError(f"{path}: its compressed body is damaged at byte {body + bad}; get a whole copy")
    parts: list[NDArray[np.generic]] = []
    at = 0
    for field, width in zip(header.fields, widths, strict=True):
        block = plain[at : at + width * header.count].view("<" + field.type).astype(field.type)
        parts.append(block.reshape(-1, field.count) if field.count > 1 and width else block)
        at += width * header.count
    return parts


def write_points(
    path: Path, points: NDArray[np.floating], data: Mapping[str, NDArray[np.generic]], encoding: str
) -> None:
    """Write one unorganized cloud in PCD 0.7; ``rgb`` and ``rgba`` are packed as in PCL.

    Args:
        path: The file.
        points: Shape (N, 3). float32 is written in 4 bytes, the only type that PCL and Open3D read as coordinates.
        data: Arrays with N rows by name.
        encoding: One of ENCODINGS.

    Raises:
        InputError: The header cannot hold a name, the format lacks a type, or a compressed body exceeds 4 GiB.
    """
    columns: Columns = dict(zip(_AXES, points.T, strict=True))
    for name, values in data.items():
        normals = name == "normals" and values.shape[1:] == (3,)
        for part, column in zip(_NORMALS, values.T, strict=True) if normals else [(name, values)]:
            if part in columns or not part.isascii() or not part.isprintable() or part in ("", _PADDING) or " " in part:
                raise InputError(f"data: '{part}' is taken or cannot be a field's name in .pcd; rename '{name}'")
            columns[part] = column
    fields, arrays = [], []
    for name, values in columns.items():
        array = _storable(name, values)
        fields.append(_Field(name, array.dtype.str[1:], 1 if array.ndim == 1 else array.shape[1]))
        arrays.append(array)
    count = len(arrays[0])
    rows = [
        ("VERSION", ["0.7"]),
        ("FIELDS", [field.name for field in fields]),
        ("SIZE", [field.type[1:] for field in fields]),
        ("TYPE", [field.type[0].upper() for field in fields]),
        ("COUNT", [str(field.count) for field in fields]),
        ("WIDTH", [str(count)]),
        ("HEIGHT", ["1"]),
        ("VIEWPOINT", ["0 0 0 1 0 0 0"]),
        ("POINTS", [str(count)]),
        ("DATA", [encoding]),
    ]
    with open(path, "wb") as file:
        file.write(b"# .PCD v0.7 - Point Cloud Data file format\n")
        file.write("".join(f"{key} {' '.join(words)}\n" for key, words in rows).encode("ascii"))
        if encoding == "ascii":
            _write_rows(file, arrays)
        elif encoding == "binary":
            table = np.empty(count, _record_type(fields))
            for at, array in enumerate(arrays):
                table[f"f{at}"] = array
            file.write(table.data if count else b"")
        else:
            _write_compressed(file, arrays)


def _storable(name: str, values: NDArray[np.generic]) -> NDArray[np.generic]:
    channels = 1 if values.ndim == 1 else values.shape[1]
    if name in _COLORS and channels == len(name):
        # PCL and Open3D take any field of this name for packed bytes.
        values = integer_colors(values, np.uint8)
    if name in _COLORS and values.dtype == np.uint8 and channels == len(name):
        packed = np.zeros((len(values), 4), np.uint8)
        packed[:, [2, 1, 0, 3][:channels]] = values
        return packed.view("<f4" if name == "rgb" else "<u4")[:, 0]
    if channels == 0:
        raise InputError(f"data: '{name}' has no columns; leave it out")
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind == "f":
        return values.astype("<f4" if values.dtype.itemsize <= 4 else "<f8")
    return values.astype(values.dtype.newbyteorder("<"))


def _write_rows(file: io.BufferedWriter, arrays: Sequence[NDArray[np.generic]]) -> None:
    """Write rows with the fewest digits that read back as the same numbers."""
    parts: list[list[str]] = []
    for array in arrays:
        for column in (array[:, None] if array.ndim == 1 else array).T:
            # A float32 has its own shortest digits, fewer than those of the equal float64.
            parts.append(list(map(str, column)) if column.dtype == np.float32 else list(map(repr, column.tolist())))
    file.writelines((" ".join(row) + "\n").encode("ascii") for row in zip(*parts, strict=True))


def _write_compressed(file: io.BufferedWriter, arrays: Sequence[NDArray[np.generic]]) -> None:
    from geokit.formats.pcd import compress

    size = sum(array.nbytes for array in arrays)
    if size > LZF_LIMIT:
        raise InputError(f"encoding: {size} bytes are more than binary_compressed can hold (4 GiB); use 'binary'")
    # Field after field, because equal bytes are then closer together than in records, and compress better.
    plain = np.concatenate([np.ascontiguousarray(array).view(np.uint8).reshape(-1) for array in arrays])
    packed = compress(plain)
    if len(packed) > LZF_LIMIT:
        raise InputError("encoding: the compressed body would be over 4 GiB; use 'binary'")
    file.write(struct.pack("<II", len(packed), size))
    file.write(packed.data)


def decompress(packed: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], int]:
    """Decompress ``packed`` to ``size`` bytes; also returns the first damaged byte of ``packed``, or -1.

    Damage is a reference before the beginning, a run beyond the end, or a size other than the declared one.
    """
    from geokit.native.parsers.extension import parsers

    core = parsers()
    if core is None:
        return _decompress(packed.tobytes(), size)
    out = np.zeros(size, np.uint8)
    return out, int(core.lzf_decompress(np.ascontiguousarray(packed), out))


def compress(plain: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Compress ``plain`` with LZF; the result is at most a 32nd longer."""
    from geokit.native.parsers.extension import parsers

    core = parsers()
    if core is None:
        return np.frombuffer(_compress(plain.tobytes()), np.uint8)
    out = np.empty(len(plain) + len(plain) // LITERAL_RUN + 2, np.uint8)
    return out[: int(core.lzf_compress(np.ascontiguousarray(plain), out))]


def _decompress(packed: bytes, size: int) -> tuple[NDArray[np.uint8], int]:
    out = bytearray()
    at = start = 0
    sound = True
    while sound and at < len(packed):
        start = at
        control = packed[at]
        at += 1
        if control < LITERAL_RUN:
            run = packed[at : at + control + 1]
            sound = len(run) == control + 1 <= size - len(out)
            out += run if sound else b""
            at += control + 1
            continue
        long = control >> 5 == 7
        if at + 1 + long > len(packed):
            sound = False
            continue
        length = (control >> 5) + 2 + (packed[at] if long else 0)
        distance = ((control & 31) << 8 | packed[at + long]) + 1
        at += 1 + long
        sound = distance <= len(out) and length <= size - len(out)
        if sound:
            # A reference may overlap its own output, whose bytes then repeat.
            piece = out[len(out) - distance :][:length]
            out += (piece * (length // len(piece) + 1))[:length]
    found = np.zeros(size, np.uint8)
    found[: len(out)] = np.frombuffer(out, np.uint8)
    return found, -1 if sound and len(out) == size else start


def _compress(plain: bytes) -> bytes:
    """Compress to the same bytes as the C++ version."""
    out = bytearray()
    table: dict[int, int] = {}
    at = start = 0
    while at < len(plain):
        length = distance = 0
        if at + 2 < len(plain):
            slot = (int.from_bytes(plain[at : at + 3], "big") * 2654435761 & 0xFFFFFFFF) >> (32 - TABLE_BITS)
            seen = table.get(slot, -1)
            table[slot] = at
            distance = at - seen
            if seen >= 0 and distance <= LARGEST_DISTANCE and plain[seen : seen + 3] == plain[at : at + 3]:
                longest = min(len(plain) - at, LONGEST_MATCH)
                length = 3
                while length < longest and plain[seen + length] == plain[at + length]:
                    length += 1
        if not length:
            at += 1
            continue
        _add_literals(out, plain[start:at])
        code, back = length - 2, distance - 1
        out += bytes([min(code, 7) << 5 | back >> 8, *([code - 7] if code >= 7 else []), back & 255])
        at = start = at + length
    _add_literals(out, plain[start:])
    return bytes(out)


def _add_literals(out: bytearray, literals: bytes) -> None:
    for at in range(0, len(literals), LITERAL_RUN):
        run = literals[at : at + LITERAL_RUN]
        out.append(len(run) - 1)
        out += run
