"""Accessors of glTF 2.0 as arrays: strides, sparse entries, normalized integers; and arrays as new accessors."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Accessors"]

_KINDS: dict[int, np.dtype[Any]] = {
    5120: np.dtype("<i1"), 5121: np.dtype("<u1"), 5122: np.dtype("<i2"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}  # fmt: skip
_CODES = {kind: code for code, kind in _KINDS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TYPES = {width: name for name, width in _WIDTHS.items()}
# An accessor without a buffer holds zeros, so its count is bounded by nothing in the file.
_MOST_ZEROS = 1 << 27


class Accessors:
    """The accessors of a file. Damaged ones raise ValueError, KeyError, IndexError or TypeError, as they come.

    Args:
        tree: The file's JSON, to which arrays are added.
        binary: The binary chunk of a .glb.
        read: Reads another file that this one refers to.
    """

    def __init__(self, tree: dict[str, Any], binary: bytes, read: Callable[[str], bytes]) -> None:
        self.tree = tree
        self._binary, self._read = binary, read
        self._buffers: dict[int, bytes] = {}

    def stored(self, index: int) -> NDArray[Any]:
        """The numbers as they are stored, (N, C), with sparse entries in place."""
        accessor = self._entry("accessors", index)
        kind, width, count = _KINDS[accessor["componentType"]], _WIDTHS[accessor["type"]], _size(accessor["count"])
        if "bufferView" in accessor:
            values = self._rows(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width)
        else:
            if count * width > _MOST_ZEROS:
                raise ValueError(f"accessor {index} has {count} elements and no buffer")
            values = np.zeros((count, width), kind)
        sparse = accessor.get("sparse")
        if sparse is not None:
            values = values.copy()
            changed, place, new = _size(sparse["count"]), sparse["indices"], sparse["values"]
            where = self._rows(
                place["bufferView"], place.get("byteOffset", 0), _KINDS[place["componentType"]], changed, 1
            )
            values[where[:, 0]] = self._rows(new["bufferView"], new.get("byteOffset", 0), kind, changed, width)
        return values

    def numbers(self, index: int) -> NDArray[np.float64]:
        """The numbers that are meant, (N, C): normalized integers are divided by their largest."""
        values = self.stored(index)
        if self.tree["accessors"][index].get("normalized") is True and values.dtype.kind in "iu":
            # As the specification has it: the most negative integer is -1 as well.
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values.astype(np.float64)

    def add(self, values: NDArray[Any], *, normalized: bool = False) -> int:
        """Add an array (N, C) in a buffer of its own; returns the number of its accessor."""
        kind = np.dtype(values.dtype).newbyteorder("<")
        data = np.ascontiguousarray(values, kind).tobytes()
        uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        buffer = _added(self.tree, "buffers", {"byteLength": len(data), "uri": uri})
        view = _added(self.tree, "bufferViews", {"buffer": buffer, "byteLength": len(data)})
        place = {
            "bufferView": view, "componentType": _CODES[kind], "count": len(values), "type": _TYPES[values.shape[1]],
        }  # fmt: skip
        return _added(self.tree, "accessors", {**place, "normalized": True} if normalized else place)

    def _rows(self, view: int, offset: Any, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        place = self._entry("bufferViews", view)
        step = _size(place.get("byteStride") or width * kind.itemsize)
        start = _size(place.get("byteOffset", 0)) + _size(offset)
        # An array of no rows may begin at the end of its buffer.
        buffer = self.buffer(place["buffer"]) if count else b""
        return np.ndarray((count, width), kind, buffer, start if count else 0, (step, kind.itemsize))

    def buffer(self, number: int) -> bytes:
        """The content of a buffer."""
        if number not in self._buffers:
            uri = self._entry("buffers", number).get("uri")
            if uri is None:
                self._buffers[number] = self._binary
            else:
                head, _, content = str(uri).partition(",")
                is_inline = head.startswith("data:") and head.endswith(";base64")
                self._buffers[number] = base64.b64decode(content) if is_inline else self._read(str(uri))
        return self._buffers[number]

    def _entry(self, name: str, index: Any) -> dict[str, Any]:
        if not isinstance(index, int) or index < 0:
            raise IndexError(f"{name}: {index!r}")
        entry: dict[str, Any] = self.tree[name][index]
        return entry


def _added(tree: dict[str, Any], name: str, entry: dict[str, Any]) -> int:
    tree.setdefault(name, []).append(entry)
    return len(tree[name]) - 1


def _size(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{value!r} is no size")
    return value
