"""The header of the polygon file format (.ply), which meshes and point clouds share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from geokit.errors import FileFormatError

__all__ = ["PlyElement", "PlyProperty", "read_header"]

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
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class PlyProperty:
    """A property of an element: its name and NumPy type; ``count_type`` is that of a list's length, "" for a scalar."""

    name: str
    type: str
    count_type: str = ""


@dataclass
class PlyElement:
    """An element: its name, how many there are, and what each has."""

    name: str
    count: int
    properties: list[PlyProperty] = field(default_factory=list)


def read_header(data: bytes, path: Path) -> tuple[str, list[PlyElement], int]:
    """Byte order ("" for ASCII, "<" or ">"), the elements in file order, and where the body begins.

    Raises:
        FileFormatError: No .ply file, a header without end or format, or a line that is not understood.
    """
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise FileFormatError(f"{path}: does not start with 'ply'; the file is damaged or not a .ply file")
    end = data.find(b"end_header")
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise FileFormatError(f"{path}: the header has no end; the file is truncated, get a whole copy")
    order = None
    elements: list[PlyElement] = []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element" and words[2].isdecimal() and words[1] not in [e.name for e in elements]:
                elements.append(PlyElement(words[1], int(words[2])))
            elif words[0] == "property" and words[-1] not in [p.name for p in elements[-1].properties]:
                elements[-1].properties.append(_property(words))
            else:
                raise ValueError(line)
        except (ValueError, KeyError, IndexError):
            raise FileFormatError(f"{path}: header line '{line[:80]}' is not understood; the file is damaged") from None
    if order is None:
        raise FileFormatError(f"{path}: the header names no format; the file is damaged")
    return order, elements, newline + 1


def _property(words: list[str]) -> PlyProperty:
    if words[1] == "list":
        return PlyProperty(words[4], _TYPES[words[3]], _TYPES[words[2]])
    return PlyProperty(words[2], _TYPES[words[1]])
