"""Zero-copy exchange of arrays with other libraries, through DLPack and the CUDA array interface."""

from __future__ import annotations

import ctypes
import functools
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from geokit.core.base.late_warp import wp
from geokit.core.launches.cuda_driver import cuda_driver
from geokit.core.require import require_memory, require_unrecorded
from geokit.errors import InputError

# Types of numbers of other libraries that kernels do not take.
WIDENED = {"float16", "bfloat16", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


def is_exporter(values: Any) -> bool:
    # NumPy reads everything without these protocols (pandas columns, memory views, nested lists).
    return hasattr(values, "__dlpack__") or hasattr(values, "__cuda_array_interface__")


def import_array(values: Any, name: str) -> "wp.array":
    if isinstance(values, wp.array) and values.requires_grad:
        require_unrecorded(values, name)
        values = detached(values)
    if getattr(values, "requires_grad", False):
        raise InputError(f"{name}: the {type(values).__name__} requires gradients, which are not recorded; detach() it")
    try:
        if hasattr(values, "__dlpack__"):
            from geokit.core.launcher import resolve_device

            resolve_device("cpu")  # starts warp, which sharing does not
            torch = sys.modules.get("torch")
            if torch is not None and isinstance(values, torch.Tensor):
                require_memory(values)
                device = wp.device_from_torch(values.device)
                return wp.from_torch(values) if is_in_order(torch, device) else wp.from_dlpack(values)
            device, _ = values.__dlpack_device__()
            if isinstance(device, int):
                return wp.from_dlpack(values)
            # warp compares the device with plain numbers; Open3D names it by an enumeration of its own.
            return wp.from_dlpack(values.__dlpack__())
        interface = values.__cuda_array_interface__
        dtype = wp.dtype_from_numpy(np.dtype(interface["typestr"]))
        array = wp.array(
            ptr=interface["data"][0],
            dtype=dtype,
            shape=interface["shape"],
            strides=interface.get("strides"),
            device=_device_of_pointer(interface["data"][0]),
            copy=False,
        )
        array._geokit_source = values
        return array
    except Exception as error:  # of the other library, the driver, or warp
        kind = type(values).__name__
        raise InputError(f"{name}: the {kind} cannot be shared ({error}); pass a contiguous float array") from error


def _device_of_pointer(pointer: int) -> str:
    # The protocol does not name the GPU; the driver knows it.
    ordinal = ctypes.c_int(-1)
    attribute_device_ordinal = 9  # CU_POINTER_ATTRIBUTE_DEVICE_ORDINAL
    status = cuda_driver().cuPointerGetAttribute(
        ctypes.byref(ordinal), attribute_device_ordinal, ctypes.c_uint64(pointer)
    )
    return f"cuda:{ordinal.value}" if status == 0 else "cuda:0"


def exporter_like(values: Any) -> Callable[["wp.array"], Any]:
    """A function that converts a result into the kind of array that ``values`` is.

    It uses ``from_dlpack`` of the array type, else of the type's library; without either it returns a warp array.
    """
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(values, torch.Tensor):
        return lambda out: _to_torch(torch, as_table(out))
    kind = type(values)
    importer = getattr(kind, "from_dlpack", None)
    if importer is None and hasattr(values, "__array_namespace__"):
        importer = getattr(values.__array_namespace__(), "from_dlpack", None)
    if importer is None:
        library = sys.modules.get(kind.__module__.partition(".")[0])
        importer = getattr(library, "from_dlpack", None) or getattr(
            getattr(library, "dlpack", None), "from_dlpack", None
        )
    if importer is None:
        return as_table
    return lambda out: importer(as_table(out))


def _to_torch(torch: Any, out: "wp.array") -> Any:
    return torch.utils.dlpack.from_dlpack(wp.to_dlpack(out) if is_in_order(torch, out.device) else out)


def is_in_order(torch: Any, device: "wp.Device") -> bool:
    """Whether torch's work and warp's on a device follow each other without events, which take 40 us an array.

    So it is on the same stream, and where torch works on CUDA's null stream: blocking streams, such as those that warp
    makes, wait for that one, and it for them.
    """
    if device.is_cpu:
        return True
    stream, other = device.stream, torch.cuda.current_stream(device.ordinal).cuda_stream
    return bool(other == (stream.cuda_stream or 0) or (other == 0 and stream.is_blocking))


def as_table(out: "wp.array") -> "wp.array":
    """View an (N,) array of vec3 as (N, 3) scalars over the same memory; return scalar arrays unchanged."""
    scalar = {wp.vec3f: wp.float32, wp.vec3d: wp.float64}.get(out.dtype)
    return out if scalar is None else reinterpreted(out, scalar, (*out.shape, 3))


def reinterpreted(array: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """View contiguous memory under another type and shape; the view keeps the owner alive."""
    view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
    view._geokit_source = array
    return view


def lead_of(values: Any) -> tuple[int, ...]:
    """Leading axes of an array of rows (..., 3): () for one row. Entries of warp's arrays of vectors are rows."""
    shape = tuple(values.shape)
    return shape if _has_vectors(values) else shape[:-1]


def flat_rows(values: Any) -> tuple[Any, tuple[int, ...] | None]:
    """Rows (..., 3) as a table (N, 3), and their leading axes; None for a table, and for what has no rows."""
    shape, lead = tuple(values.shape), lead_of(values)
    if len(lead) == 1 or (lead != shape and shape[-1:] != (3,)):
        return values, None
    if not getattr(values, "is_contiguous", True):  # warp's has no other shape
        values = values.contiguous()
    return values.reshape((math.prod(lead), *shape[len(lead) :])), lead


def led(values: Any, lead: tuple[int, ...]) -> Any:
    """The inverse of :func:`flat_rows` for what has an entry for each row: (N, ...) as (*lead, ...)."""
    return values.reshape((*lead, *values.shape[1:])) if lead else values[0]


def broadcast_rows(tables: dict[str, Any]) -> dict[str, Any]:
    """Arrays of rows by name, (..., 3), of which one row of shape (3,) is repeated for all rows of the others.

    Raises:
        InputError: Other leading axes differ.
    """
    given = {name: rows for name, rows in tables.items() if tuple(rows.shape) in (lead_of(rows), (*lead_of(rows), 3))}
    lead = next((found for value in given.values() if (found := lead_of(value))), ())
    for name, value in given.items():
        if (own := lead_of(value)) not in ((), lead):
            counts = (own[0], lead[0]) if len(own) == len(lead) == 1 else (own, lead)
            first = next(iter(tables))
            raise InputError(
                f"{name}: {counts[0]} rows for {counts[1]} {first}; give one for each, or one of shape (3,) for all"
            )
        if own != lead:
            tables = tables | {name: _repeated(value, (*lead, 3), name)}
    return tables


def _repeated(row: Any, shape: tuple[int, ...], name: str) -> Any:
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(row, torch.Tensor):
        return row.expand(shape)
    if not isinstance(row, np.ndarray) and hasattr(row, "__array_namespace__"):
        return row.__array_namespace__().broadcast_to(row, shape)
    if isinstance(row, np.ndarray):
        return np.broadcast_to(row, shape)
    shared = import_array(row, name)
    table: Any = wp.array(np.broadcast_to(shared.numpy(), shape), dtype=shared.dtype, device=shared.device)
    return table if isinstance(row, wp.array) else exporter_like(row)(table)


def _has_vectors(values: Any) -> bool:
    warp = sys.modules.get("warp")
    if warp is None or not isinstance(values, warp.array):
        return False
    return values.dtype in (warp.vec3f, warp.vec3d)


def widened(values: Any) -> Any:
    """An exporter of 16-bit floats or of integers as one of float64 (float32 where its library has no other)."""
    kind = getattr(values, "dtype", None)
    if kind is None or not _is_widened(kind):
        return values
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(values, torch.Tensor):
        return values.to(torch.float64)
    jax = sys.modules.get("jax")
    if jax is not None and isinstance(values, jax.Array):
        return values.astype("float64" if jax.config.jax_enable_x64 else "float32")
    return values.astype("float64") if hasattr(values, "astype") else values


@functools.lru_cache(maxsize=64)
def _is_widened(kind: Any) -> bool:
    name = getattr(kind, "name", None) or str(kind)
    return name.rpartition(".")[2] in WIDENED


def detached(array: "wp.array") -> "wp.array":
    """An array of warp over the same memory that requires no gradient; a copy if it is not contiguous."""
    if not array.is_contiguous:
        copy: Any = wp.empty(array.shape, dtype=array.dtype, device=array.device)
        wp.copy(copy, array)  # between arrays of which one has no gradient, which no tape records
        return copy
    return reinterpreted(array, array.dtype, array.shape)
