"""Points in .vdb files: OpenVDB's PointDataGrid, read by forks of a process that has OpenVDB ready.

OpenVDB keeps a position as float32 within its voxel, and knows neither unsigned integers nor all names. What an array
was called and which type it had stands as JSON in the grid's metadata, so that geokit reads what it wrote.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._warn import warn
from geokit.core.files import in_one_line
from geokit.errors import InputError
from geokit.formats.reader import process as reader_process
from geokit.native import _metadata
from geokit.native._failures import raise_failure
from geokit.native._openvdb import _call, _extension
from geokit.native._served import prepare
from geokit.native._worker import warn_of_version

__all__ = ["prepare", "read", "read_grids", "write"]

# As in _served.py: address space of Python, the libraries and their threads.
RESERVED_BYTES = 1 << 30
# The tree, its columns and the answer.
COPIES = 4
# Houdini's names.
NAMES = {"N": "normals", "Cd": "rgb"}
# Types of the file's columns.
_TYPES = {
    "bool": "?", "group": "?", "int8": "i1", "int16": "i2", "int32": "i4", "int64": "i8", "float": "f4", "double": "f8",
    "vec3i": "i4", "vec3s": "f4", "vec3d": "f8", "quats": "f4", "quatd": "f8",
}  # fmt: skip
# Types of scalars and of rows of three, by NumPy's, and where others go without loss.
_SCALARS = {"?": "bool", "i1": "int8", "i2": "int16", "i4": "int32", "i8": "int64", "f4": "float", "f8": "double"}
_VECTORS = {"i4": "vec3i", "f4": "vec3s", "f8": "vec3d"}
_WIDER = {"u1": "i2", "u2": "i4", "u4": "i8", "u8": "i8", "f2": "f4"}
# Characters that OpenVDB takes in names.
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_.|:]")
# Points of a voxel, if they fill the box evenly: OpenVDB's own default.
PER_VOXEL = 8
# Voxels along the longest side, so that a place of 20 bits for each axis and one of 9 in the leaf are one integer.
MOST_VOXELS = 1 << 20
# OpenVDB takes voxels of more than 3e-15 in volume.
SMALLEST_EDGE = 2.0**-16
# Where an edge is this share of a coordinate, float32 within the voxel rounds no more than float64.
ROUNDING = 2.0**-26


def read(
    path: Path, grid: str | None, limit: int, trusted: bool
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Read one grid of points, in the order of its voxels.

    Args:
        path: The file.
        grid: Its name; None for the only one that holds points.
        limit: Largest size of its arrays in bytes.
        trusted: Whether to read in this process.
    Raises:
        FileFormatError: The file is damaged, or reading it exceeded a limit.
        InputError: No grid of points has the name, or none is given and there are several.
        MissingDependencyError: The extension is not available.
        UnsupportedGridError: The grid has no positions as OpenVDB keeps them.
        WorkerError: The process did not start, or was killed from outside.
    """
    _extension()
    names = [] if grid is None else [grid]
    warn_of_version(path)
    if trusted:
        facts, arrays = read_grids(path, names)
    else:
        request = reader_process.request_of(path, "grids", limit, names)
        request["memory"] = RESERVED_BYTES + COPIES * limit
        seconds = reader_process.reading_seconds(path)
        facts, arrays = reader_process.ask(path, __name__, request, seconds, "restore it from its source")
    if "error" in facts:
        raise_failure(facts["error"], str(path))
    if facts["left_out"]:
        left = in_one_line(", ".join(sorted(facts["left_out"])))
        warn(f"{path}: attributes that are no numbers are left out: {left}")
    (_, positions), *columns = arrays
    noted = _noted(facts["note"])
    data: dict[str, NDArray[np.generic]] = {}
    for label, values in columns:
        name, values = _as_noted(label, values, noted)
        data[name if name not in data else label] = values
    return positions.reshape(-1, 3), data


def read_grids(path: Path, names: list[str]) -> tuple[Any, list[tuple[str, NDArray[Any]]]]:
    """What the process answers: facts, which may be an error, and the positions before the other arrays."""
    extension = importlib.import_module("geokit.native._bridge")
    name = _metadata.raw(names[0]) if names else b""
    try:
        positions, columns, left_out, note = extension.read_points(os.fsencode(path), name)
    except extension.BridgeError as error:
        return json.loads(error.args[0].decode("utf-8", "surrogateescape")), []
    found = [("", positions)]
    for label, kind, width, values in columns:
        rows = values.view(_TYPES[kind]).reshape(-1, width) if width != 1 else values.view(_TYPES[kind])
        found.append((_metadata.text(label), rows))
    facts = {"left_out": [_metadata.text(one) for one in left_out], "note": _metadata.text(note)}
    return facts, found


def _noted(note: str) -> dict[str, Any]:
    """What :func:`write` said of the arrays; nothing for a file of another program."""
    try:
        found = json.loads(note)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _as_noted(label: str, values: NDArray[Any], noted: dict[str, Any]) -> tuple[str, NDArray[Any]]:
    """The name and the values of a column as they were written."""
    name, kind, columns = label, values.dtype.str[1:], values.ndim
    if label in noted:
        try:
            name, kind, columns = (cast(noted[label][at]) for at, cast in enumerate((str, str, int)))
        except (TypeError, ValueError, KeyError, IndexError):
            return NAMES.get(label, label), values
    else:
        name = NAMES.get(label, label)
    if columns == 2 and values.ndim == 1:
        values = values[:, None]
    if label == "Cd" and kind in ("u1", "u2") and values.dtype.kind == "f":
        full = np.iinfo(kind).max
        return name, np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * np.float64(full)).astype(kind)
    if kind in _WIDER and values.dtype.str[1:] == _WIDER[kind]:
        with np.errstate(over="ignore"):
            narrow = values.astype(kind)
        return name, narrow if np.array_equal(narrow, values, equal_nan=kind == "f2") else values
    return name, values


def write(part: Path, points: NDArray[np.float64], data: Mapping[str, NDArray[np.generic]], path: Path) -> None:
    """Write points as one grid called "points".

    Args:
        part: The file.
        points: Positions.
        data: Their arrays.
        path: What the file is called in messages.
    Raises:
        InputError: An array holds whole numbers beyond 63 bits, or the points lie too far apart for float64.
        MissingDependencyError: The extension is not available.
    """
    extension = _extension()
    edge, origin = _lattice(points)
    inside = (points - origin) / edge
    voxel = np.rint(inside).astype(np.int64)
    leaf, within = voxel >> 3, voxel & 7
    place = (within[:, 0] << 6) | (within[:, 1] << 3) | within[:, 2]
    key = (leaf[:, 0] << 34 | leaf[:, 1] << 17 | leaf[:, 2]) << 9 | place
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order] >> 9, prepend=-1))
    columns, note = _columns(data, order)
    arguments = (
        np.ascontiguousarray(leaf[order[starts]] << 3, np.int32),
        np.append(starts, len(points)).astype(np.int64),
        place[order].astype(np.uint16),
        np.ascontiguousarray((inside - voxel)[order], np.float32),
        columns,
        json.dumps(note).encode(),
        "blosc",
    )
    place_and_name = (os.fsencode(part), b"points", edge, origin.tolist())
    _call(path, lambda: extension.write_points(*place_and_name, *arguments), is_argument=True)


def _lattice(points: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """The edge of a voxel, a power of two so that scaling rounds nothing, and the center of the first, a multiple."""
    if not len(points):
        return 1.0, np.zeros(3)
    lower = points.min(axis=0)
    with np.errstate(over="ignore"):
        extent = points.max(axis=0) - lower
    longest = float(extent.max())
    if not math.isfinite(longest):
        raise InputError("points: lie too far apart for float64; scale them down")
    edge = max(SMALLEST_EDGE, float(np.abs(points).max()) * ROUNDING)
    if longest > 0.0:
        wide = extent[extent > longest / MOST_VOXELS] / longest
        share = float(np.prod(wide) * PER_VOXEL / len(points)) ** (1 / len(wide))
        edge = max(edge, share * longest, 2 / MOST_VOXELS * longest)
    edge = 2.0 ** math.ceil(math.log2(edge))
    return edge, np.floor(lower / edge) * edge


def _columns(
    data: Mapping[str, NDArray[np.generic]], order: NDArray[np.int64]
) -> tuple[list[tuple[bytes, str, int, NDArray[np.uint8]]], dict[str, Any]]:
    """The arrays as the extension takes them, and the names and types that they had."""
    columns: list[tuple[bytes, str, int, NDArray[np.uint8]]] = []
    note: dict[str, Any] = {}
    for name, given in data.items():
        values, kind = given[order], given.dtype.str[1:].replace("b1", "?")
        width = values.shape[1] if values.ndim == 2 else 1
        if not width:
            raise InputError(f"data['{name}']: has no columns, which .vdb cannot hold; leave it out")
        label = next((short for short, long in NAMES.items() if long == name and width == 3), name)
        label = _free_name(_NOT_IN_NAMES.sub("_", label) or "_", {"P", *note})
        note[label] = [name, kind, values.ndim]
        if label == "Cd" and kind in ("u1", "u2"):
            values = (values / np.float64(np.iinfo(kind).max)).astype(np.float32)
        elif kind == "u8" and len(values) and values.max() > np.uint64(np.iinfo(np.int64).max):
            raise InputError(f"data['{name}']: holds numbers beyond 63 bits, which .vdb cannot hold; save .npz instead")
        elif kind in _WIDER:
            values = values.astype(_WIDER[kind])
        elif kind not in _SCALARS:
            values = values.astype(np.float64)
        kind = values.dtype.str[1:].replace("b1", "?")
        type_name = _VECTORS[kind] if width == 3 and kind in _VECTORS else _SCALARS[kind]
        stored = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        columns.append((label.encode(), type_name, width, stored.reshape(-1).view(np.uint8)))
    return columns, note


def _free_name(name: str, taken: set[str]) -> str:
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free
