"""Accessors of glTF 2.0 as arrays: strides, sparse entries, normalized integers; and arrays as new accessors.

Damaged files hold anything: an entry of their JSON that is not of the kind asked for counts as absent.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileFormatError

_KINDS: dict[int, np.dtype[Any]] = {
    5120: np.dtype("<i1"), 5121: np.dtype("<u1"), 5122: np.dtype("<i2"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}  # fmt: skip
FLOAT = 5126
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
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
        self._added: dict[int, NDArray[Any]] = {}

    def stored(self, index: int) -> NDArray[Any]:
        """The numbers as they are stored, (N, C), with sparse entries in place."""
        if index in self._added:
            return self._added[index]
        accessor = self.entry("accessors", index)
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

    def add(self, values: NDArray[Any]) -> int:
        """Add an array (N, C) as float32; returns the number of its accessor."""
        index = len(self.tree["accessors"])
        kind = next(name for name, width in _WIDTHS.items() if width == values.shape[1])
        self.tree["accessors"].append({"componentType": FLOAT, "count": len(values), "type": kind})
        self._added[index] = np.ascontiguousarray(values, "<f4")
        return index

    def _rows(self, view: int, offset: Any, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        content, row, start = self.view(view), width * kind.itemsize, _size(offset)
        step = _size(self.tree["bufferViews"][view].get("byteStride", row))
        if not count:
            return np.empty((0, width), kind)  # which may begin at the end of its view
        # NumPy does not check this for a view without bytes.
        if not step or start + (count - 1) * step + row > len(content):
            raise ValueError(f"{count} elements of {row} bytes reach beyond buffer view {view}")
        return np.ndarray((count, width), kind, content, start, (step, kind.itemsize))

    def view(self, number: int) -> memoryview:
        """The bytes of a buffer view.

        Raises:
            FileFormatError: The buffer is cut off.
        """
        place = self.entry("bufferViews", number)
        first, size = _size(place.get("byteOffset", 0)), _size(place["byteLength"])
        content = self._buffer(place["buffer"])
        if first + size > len(content):
            entry = self.entry("buffers", place["buffer"])
            uri, told = str(entry.get("uri", "data:")), entry.get("byteLength")
            if isinstance(told, int) and len(content) < told:
                name = "in the file" if uri.startswith("data:") else repr(uri[:80])
                raise FileFormatError(
                    f"buffer {place['buffer']} ({name}) has {len(content)} of its {told} bytes; get a whole copy"
                )
            raise ValueError(f"buffer view {number} reaches beyond its buffer")
        return memoryview(content)[first : first + size]

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            uri = self.entry("buffers", number).get("uri")
            if uri is None and number:
                raise ValueError(f"buffer {number} has no content")
            if uri is None:
                self._buffers[number] = self._binary
            else:
                head, _, content = str(uri).partition(",")
                is_inline = head.startswith("data:") and head.endswith(";base64")
                self._buffers[number] = base64.b64decode(content) if is_inline else self._read(str(uri))
        return self._buffers[number]

    def entry(self, name: str, index: Any) -> dict[str, Any]:
        """The entry of that number in a list of the file."""
        if not isinstance(index, int) or index < 0:
            raise IndexError(f"{name}: {index!r}")
        entry: dict[str, Any] = self.tree[name][index]
        return entry


def _size(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{value!r} is no size")
    return value


def object_of(value: Any) -> dict[str, Any]:
    """The object, or an empty one."""
    return value if isinstance(value, dict) else {}


def objects(value: Any, kind: type = dict) -> list[Any]:
    """The entries of a list that are objects, or of another kind."""
    return [entry for entry in value if isinstance(entry, kind)] if isinstance(value, list) else []


def entry_of(tree: dict[str, Any], name: str, index: Any) -> dict[str, Any] | None:
    """The object of that number in a list of the file; None if there is none."""
    found = tree.get(name)
    if not isinstance(found, list) or not isinstance(index, int) or not 0 <= index < len(found):
        return None
    return found[index] if isinstance(found[index], dict) else None


def primitives_of(tree: dict[str, Any]) -> list[dict[str, Any]]:
    """The primitives of all meshes."""
    return [part for mesh in objects(tree.get("meshes")) for part in objects(mesh.get("primitives"))]
