"""Arrays of warp structs, one for each of many objects, whose arrays are parts of large ones."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core.base.forks import Lock
from geokit.core.base.late_warp import wp

_lock = Lock()


class Parts(NamedTuple):
    """Part k of an array: ``counts[k]`` elements from ``starts[k]`` on."""

    array: "wp.array"
    starts: NDArray[Any]
    counts: NDArray[Any]

    @classmethod
    def between(cls, array: "wp.array", begin: NDArray[Any], each: int = 1) -> Parts:
        """The parts from each row of ``begin`` to the next, of ``each`` elements a number."""
        return cls(array, each * begin[:-1], each * np.diff(begin))


def layout_of_struct(struct: Any) -> np.dtype[Any]:
    """NumPy type of a struct."""
    with _lock:
        return _layout_of(struct)


@functools.cache
def _layout_of(struct: Any) -> np.dtype[Any]:
    # NumPy parses each field with Python's own parser, which fails in threads that do so at the same time (CPython
    # 3.11: "AST constructor recursion depth mismatch").
    return np.dtype(struct.numpy_dtype())


def struct_array(table: NDArray[Any], struct: Any, device: "wp.Device") -> "wp.array":
    """An array of structs on a device, as ``warp.array(table, dtype=struct)``, which parses the struct at each call."""
    rows = table.copy()
    there = {"dtype": struct, "shape": (len(rows),), "device": device}
    if device.is_cpu:
        shared: Any = wp.array(ptr=rows.ctypes.data, **there)
        shared._geokit_source = rows
        return shared
    made: Any = wp.empty(**there)
    size = rows.nbytes
    if size:
        source: Any = wp.array(rows.view(np.uint8).reshape(-1), dtype=wp.uint8, device="cpu", copy=False)
        wp.copy(wp.array(ptr=made.ptr, dtype=wp.uint8, shape=(size,), device=device), source)
    return made


def struct_table(struct: Any, count: int, **fields: Any) -> NDArray[Any]:
    """Rows of structs as warp reads them, for :func:`struct_array`.

    The table holds addresses: whoever uses it keeps the arrays.

    Args:
        struct: The class of the structs.
        count: Number of structs.
        fields: Values by field: an array of one value each, a table of structs, :class:`Parts` of an array, or one
            array for all of them. Other fields are 0.
    """
    table = np.zeros(count, layout_of_struct(struct))
    for name, value in fields.items():
        if isinstance(value, wp.array):
            value = Parts(value, np.zeros(count, np.int64), np.full(count, len(value)))
        if not isinstance(value, Parts):
            table[name] = value
            continue
        part, size = table[name], wp.types.type_size_in_bytes(value.array.dtype)
        part["data"] = (value.array.ptr or 0) + np.asarray(value.starts, np.uint64) * np.uint64(size)
        part["shape"][:, 0], part["strides"][:, 0], part["ndim"] = value.counts, size, 1
    return table


def struct_rows(struct: Any, values: Iterable[Any]) -> NDArray[Any]:
    """The table of structs that exist."""
    return np.array([value.numpy_value() for value in values], layout_of_struct(struct))


def handed_out(struct: Any, device: "wp.Device", owner: Any) -> Any:
    """A struct for kernels of the user's: it keeps its owner alive, and has no array that is None, as a Tape wants."""
    for name, field in struct._cls.vars.items():
        value = getattr(struct, name)
        if value is None:
            setattr(struct, name, wp.empty(0, dtype=field.type.dtype, device=device))
        elif hasattr(value, "_cls"):
            handed_out(value, device, owner)
    struct.__dict__["_owner"] = owner
    return struct
