"""Polygon file format (.ply), ASCII and binary: the vertices and every number that goes with them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError, InputError
from geokit.formats.decimal import SMALLEST, plain_rows
from geokit.formats.ply_header import read_header

__all__ = ["read_ply", "write_ply"]

_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "b1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def read_ply(path: Path) -> dict[str, NDArray[np.generic]]:
    """The columns of the vertex element by name, each in the type of the file.

    Raises:
        FileFormatError: A damaged or truncated file, no vertices, or a list among their properties.
    """
    data = path.read_bytes()
    order, elements, start = read_header(data, path)
    if "vertex" not in [element.name for element in elements]:
        raise FileFormatError(f"{path}: has no vertex element; a point set needs one")
    vertex = elements[0]
    if vertex.name != "vertex":
        raise FileFormatError(f"{path}: element '{vertex.name}' stands before the vertices; put the vertices first")
    count = vertex.count
    lists = [item.name for item in vertex.properties if item.count_type]
    if lists:
        raise FileFormatError(f"{path}: vertex property '{lists[0]}' is a list, which geokit does not read; remove it")
    dtype = np.dtype([(item.name, order + item.type) for item in vertex.properties])
    if order == "":
        return _ascii(data[start:], dtype, count, path)
    if count * dtype.itemsize > len(data) - start:
        have = (len(data) - start) // max(dtype.itemsize, 1)
        raise FileFormatError(f"{path}: ends in vertex {have} of the {count} it declares; get a whole copy")
    table = np.frombuffer(data, dtype, count, start)
    return {name: table[name].astype(dtype[name].newbyteorder("=")) for name in dtype.names or ()}


def _ascii(body: bytes, dtype: np.dtype[np.void], count: int, path: Path) -> dict[str, NDArray[np.generic]]:
    names = dtype.names or ()
    table = _plain(body, count)
    if table is not None and table.shape == (count, len(names)):
        with contextlib.suppress(FloatingPointError):
            return _cast(table, dtype)
    lines = [line for line in body.split(b"\n") if line.strip()][:count]
    if len(lines) < count:
        raise FileFormatError(f"{path}: ends in vertex {len(lines)} of the {count} it declares; get a whole copy")
    tokens = b" ".join(lines).split()
    try:
        return _cast(np.array(tokens, dtype=np.float64).reshape(count, len(names)), dtype)
    except (ValueError, FloatingPointError):
        pass
    for row, line in enumerate(lines):
        words = line.split()
        try:
            if len(words) == len(names):
                list(map(float, words))
                continue
        except ValueError:
            pass
        shown = line[:60].decode("ascii", "backslashreplace").strip()
        raise FileFormatError(f"{path}: vertex {row} ('{shown}') is not {len(names)} numbers; the file is damaged")
    raise FileFormatError(f"{path}: a vertex has a number that its type cannot hold; the file is damaged")


def _plain(body: bytes, count: int) -> NDArray[np.float64] | None:
    """The first ``count`` lines, where they are many and ordinary; faces may follow them."""
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n")) if len(body) >= SMALLEST else np.empty(0)
    return plain_rows(body, 0, int(ends[count - 1])) if 0 < count <= len(ends) else None


def _cast(table: NDArray[np.float64], dtype: np.dtype[np.void]) -> dict[str, NDArray[np.generic]]:
    with np.errstate(invalid="raise", over="ignore"):
        return {name: table[:, at].astype(dtype[name]) for at, name in enumerate(dtype.names or ())}


def write_ply(path: Path, names: Sequence[str], columns: Sequence[NDArray[np.generic]]) -> None:
    """A binary little-endian file with one vertex element.

    Raises:
        InputError: A column has a type that the format lacks and that does not fit into one that it has.
    """
    narrow = [_fitting(column, name) for name, column in zip(names, columns, strict=True)]
    dtype = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in zip(names, narrow, strict=True)])
    count = len(columns[0])
    table = np.empty(count, dtype)
    for name, column in zip(names, narrow, strict=True):
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property {_NAMES[column.dtype.str[1:]]} {name}" for name, column in zip(names, narrow, strict=True)]
    with open(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(table.tobytes())


def _fitting(column: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    if column.dtype.str[1:] in _NAMES:
        return column.astype(np.uint8) if column.dtype.kind == "b" else column
    if column.dtype.kind == "f":
        return column.astype(np.float64 if column.dtype.itemsize > 4 else np.float32)
    limits = np.iinfo(np.int32)
    if column.size and (column.min() < limits.min or column.max() > limits.max):
        raise InputError(f"data: '{name}' has integers beyond 32 bits, which .ply cannot hold; write .npz or .vtp")
    return column.astype(np.int32)
