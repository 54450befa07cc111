"""Converts OpenVDB metadata to Python values whose types stand for the OpenVDB types, and back.

==================================  ==========================================================
OpenVDB                             Python
==================================  ==========================================================
string, bool, int64, double         str, bool, int, float
int32, float                        np.int32, np.float32
vec2i, vec3i, vec4i                 tuple of int
vec2d, vec3d, vec4d                 tuple of float
vec2s, vec3s, vec4s                 tuple of np.float32
mat4d, mat4s                        tuple of 4 tuples of 4 float or np.float32
any other                           RawMetadata(type, data); plain bytes where the type is "bytes"
==================================  ==========================================================

The mapping is one-to-one, so a value that was read from a file is written back with the same type and bits.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from geokit.errors import InputError


class RawMetadata(NamedTuple):
    """A metadata value of a type that OpenVDB does not know, kept byte for byte.

    Attributes:
        type: OpenVDB's name of the type.
        data: Its bytes.
    """

    type: str
    data: bytes


# In front of the names of metadata of a file, which each of its grids has beside its own.
FILE = "geokit:file:"
# OpenVDB's name of a grid of points with attributes.
POINTS = "Tree_ptdataidx32_5_4_3"
# OpenVDB's value types whose names geokit.volume.GridInfo spells differently.
_GRID_TYPES = {"vec3s": "vec3f", "vec4s": "vec4f"}

# OpenVDB type -> struct code and number of values.
_LAYOUTS = {
    "bool": ("?", 1),
    "int32": ("i", 1),
    "int64": ("q", 1),
    "float": ("f", 1),
    "double": ("d", 1),
    **{f"vec{n}{kind}": (code, n) for n in (2, 3, 4) for kind, code in (("i", "i"), ("s", "f"), ("d", "d"))},
    "mat4s": ("f", 16),
    "mat4d": ("d", 16),
    "uint32": ("I", 1),  # only as a grid's background
}


def text(raw: bytes) -> str:
    """Decode a name or string of a .vdb file; bytes that are not UTF-8 become surrogates."""
    return raw.decode("utf-8", "surrogateescape")


def raw(value: str) -> bytes:
    """The inverse of :func:`text`."""
    return value.encode("utf-8", "surrogateescape")


def decode(type_name: str, data: bytes) -> Any:
    """Python value of serialized OpenVDB metadata."""
    if type_name == "string":
        return text(data)
    if type_name not in _LAYOUTS:
        return data if type_name == "bytes" else RawMetadata(type_name, data)
    code, count = _LAYOUTS[type_name]
    if struct.calcsize(f"<{count}{code}") != len(data):
        return RawMetadata(type_name, data)
    values = struct.unpack(f"<{count}{code}", data)
    if code == "f":
        # Read from the bytes, not through a double, so that a signaling NaN keeps its bits.
        values = tuple(np.frombuffer(data, "<f4"))
    if type_name == "int32":
        return np.int32(values[0])
    if count == 1:
        return values[0]
    if count == 16:
        return tuple(values[i : i + 4] for i in range(0, 16, 4))
    return values


def decode_all(items: list[dict[str, str]]) -> dict[str, Any]:
    """Decode the metadata items of the worker's JSON into a dict by name."""
    return {item["name"]: decode(item["type"], bytes.fromhex(item["hex"])) for item in items}


def decode_grids(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The metadata of each grid in the worker's JSON, and beside them those of the file."""
    of_file = {FILE + name: value for name, value in decode_all(result["metadata"]).items()}
    return [{**decode_all(description["metadata"]), **of_file} for description in result["grids"]]


def split(grids: Iterable[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The inverse: the metadata of each grid, and those of the file, each as the first grid that has it says."""
    own: list[dict[str, Any]] = []
    of_file: dict[str, Any] = {}
    for metadata in grids:
        own.append({})
        for name, value in metadata.items():
            if isinstance(name, str) and name.startswith(FILE):
                of_file.setdefault(name[len(FILE) :], value)
            else:
                own[-1][name] = value
    return own, of_file


def decode_header(description: dict[str, Any], metadata: dict[str, Any]) -> dict[str, Any]:
    """Convert a grid's description in the worker's JSON to geokit's names and types."""
    header = {**description, "metadata": metadata}
    if description["convertible"]:
        value_type = description["grid_type"].split("_")[1]
        header["grid_type"] = _GRID_TYPES.get(value_type, value_type)
    elif description["grid_type"] == POINTS:
        header["grid_type"] = "points"
    for key, shape, dtype in (("transform", (4, 4), np.float64), ("index_bounds", (2, 3), np.int64)):
        if header[key] is not None:
            header[key] = np.array(header[key], dtype=dtype).reshape(shape)
    if header["background"] is not None:
        header["background"] = decode(header["background"]["type"], bytes.fromhex(header["background"]["hex"]))
    return header


def encode_all(metadata: Mapping[str, Any]) -> list[tuple[str, str, bytes]]:
    """Encode metadata as (name, OpenVDB type, bytes) for each item.

    Raises:
        InputError: The table of this module does not list the type of a value, an integer does not fit its type, or a
            name is not UTF-8, as a damaged file may hold it.
    """
    items = []
    for name, value in metadata.items():
        if (
            isinstance(name, str)
            and not name.isascii()
            and any("\ud800" <= character <= "\udfff" for character in name)
        ):
            raise InputError(f"metadata {name!r}: the name holds bytes that are not UTF-8; give it another one")
        try:
            items.append((name, *_encode(value)))
        except (TypeError, struct.error, OverflowError) as error:
            raise InputError(
                f"metadata {name!r}: {value!r} cannot be stored in a .vdb file ({error}); use a str, bool, number, "
                "a tuple of 2 to 4 numbers, bytes or RawMetadata"
            ) from None
    return items


def _encode(value: Any) -> tuple[str, bytes]:
    if isinstance(value, RawMetadata):
        return value.type, bytes(value.data)
    if isinstance(value, str):
        return "string", raw(value)
    if isinstance(value, bytes):
        return "bytes", value
    if isinstance(value, (bool, np.bool_)):
        return "bool", struct.pack("<?", bool(value))
    if isinstance(value, (np.int8, np.int16, np.int32, np.uint8, np.uint16)):
        return "int32", struct.pack("<i", int(value))
    if isinstance(value, (int, np.integer)):
        return "int64", struct.pack("<q", int(value))
    if isinstance(value, (np.float32, np.float16)):
        return "float", np.asarray(value, "<f4").tobytes()
    if isinstance(value, (float, np.floating)):
        return "double", struct.pack("<d", float(value))
    if isinstance(value, (Sequence, np.ndarray)):
        return _encode_vector(value)
    raise TypeError(f"type {type(value).__name__}")


def _encode_vector(value: Sequence[Any] | np.ndarray) -> tuple[str, bytes]:
    rows = list(value)
    if len(rows) == 4 and all(isinstance(row, (Sequence, np.ndarray)) and len(row) == 4 for row in rows):
        kind, data = _encode_numbers([number for row in rows for number in row])
        if kind == "i":
            raise TypeError("a matrix of integers")
        return f"mat4{kind}", data
    if not 2 <= len(rows) <= 4:
        raise TypeError(f"{len(rows)} values")
    kind, data = _encode_numbers(rows)
    return f"vec{len(rows)}{kind}", data


def _encode_numbers(numbers: list[Any]) -> tuple[str, bytes]:
    if any(isinstance(n, (bool, np.bool_)) or not isinstance(n, (int, float, np.number)) for n in numbers):
        raise TypeError("values that are not numbers")
    if all(isinstance(n, (int, np.integer)) for n in numbers):
        return "i", struct.pack(f"<{len(numbers)}i", *map(int, numbers))
    if all(isinstance(n, (np.float32, np.float16)) for n in numbers):
        return "s", np.array(numbers, "<f4").tobytes()
    return "d", struct.pack(f"<{len(numbers)}d", *map(float, numbers))
