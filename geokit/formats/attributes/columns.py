"""Attributes as columns of one number, as .ply and .msh have them, and their names in other programs."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

# Names of the columns of arrays with a meaning: the first are written.
_NAMES = {
    "normal": (("nx", "ny", "nz"),),
    "color": (("red", "green", "blue", "alpha"), ("red", "green", "blue"), ("r", "g", "b")),
    "uv": (("s", "t"), ("u", "v"), ("texture_u", "texture_v")),
}


def from_columns(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays from columns: those with a meaning, ``name_x name_y name_z``, ``name_0 name_1 ...``, and single ones.

    Arrays of more columns stay as they are.
    """
    rest, data = {name: values for name, values in columns.items() if values.ndim == 1}, {}
    whole_rows = {name: values for name, values in columns.items() if values.ndim > 1}
    for name, spellings in _NAMES.items():
        for spelling in spellings:
            if (
                set(spelling) <= rest.keys()
                and len({rest[part].dtype for part in spelling}) == 1
                and name not in columns
            ):
                data[name] = np.stack([rest.pop(part) for part in spelling], axis=1)
                break
    for name in list(rest):
        of, end = name[:-2], name[-2:]
        parts = [f"{of}_{axis}" for axis in "xyz"] if end == "_x" else _numbered(of, rest) if end == "_0" else []
        whole = len(parts) > 1 and set(parts) <= rest.keys()
        if whole and of and not (of in columns or of in data) and len({rest[part].dtype for part in parts}) == 1:
            data[of] = np.stack([rest.pop(part) for part in parts], axis=1)
    return {**whole_rows, **data, **rest}


def as_columns(data: Mapping[str, NDArray[Any]], taken: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """One column for each number, with names without spaces.

    Args:
        data: Arrays (N,) or (N, k) by name.
        taken: Names that columns must not have.
    """
    columns: dict[str, NDArray[Any]] = {}
    used = set(taken)
    for given, values in data.items():
        table = values.reshape(len(values), -1)
        for part, column in zip(_column_names(given, table.shape[1]), table.T, strict=True):
            name = free_name(part, used)
            columns[name] = column
            used.add(name)
    return columns


def free_name(name: str, taken: Container[str]) -> str:
    """A name of printable ASCII without spaces that is not taken."""
    free = "".join(sign if sign.isascii() and sign.isprintable() and sign != " " else "_" for sign in name)
    while free in taken:
        free += "_"
    return free


def utf8(name: str) -> str:
    """A name with "?" for bytes that are no UTF-8: meshes may have theirs from names of files."""
    return name.encode("utf-8", "replace").decode()


def xml_name(name: str) -> str:
    """A name as text of an XML attribute, which VTK and meshio do not make of it."""
    return escape("".join(sign if sign.isprintable() else "_" for sign in name), {'"': "&quot;"})


def _column_names(name: str, width: int) -> tuple[str, ...]:
    for spelling in _NAMES.get(name, ()):
        if len(spelling) == width:
            return spelling
    if width == 1:
        return (name,)
    return tuple(f"{name}_{end}" for end in ("xyz" if width == 3 else range(width)))


def _numbered(name: str, columns: Mapping[str, Any]) -> list[str]:
    """``name_0``, ``name_1``, ..., as many as there are."""
    parts: list[str] = []
    while f"{name}_{len(parts)}" in columns:
        parts.append(f"{name}_{len(parts)}")
    return parts
