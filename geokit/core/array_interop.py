"""Arrays of other libraries, by DLPack and the CUDA-array interface: as warp arrays over the same memory, and back."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = ["as_table", "imported", "is_exporter", "reexporter", "reinterpreted"]


def is_exporter(values: Any) -> bool:
    # NumPy-like things (pandas columns, memory views) are read through NumPy; these two protocols are for the others.
    return hasattr(values, "__dlpack__") or hasattr(values, "__cuda_array_interface__")


def imported(values: Any, name: str) -> "wp.array":
    import warp as wp

    try:
        if hasattr(values, "__dlpack__"):
            return wp.from_dlpack(values)
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
    except (RuntimeError, TypeError, ValueError, AttributeError, BufferError, KeyError) as error:
        kind = type(values).__name__
        raise InputError(f"{name}: the {kind} cannot be shared ({error}); pass a contiguous float array") from error


def _device_of_pointer(pointer: int) -> str:
    # The protocol does not say which GPU: the driver does.
    import ctypes

    driver = ctypes.CDLL("libcuda.so.1")
    ordinal = ctypes.c_int(-1)
    attribute_device_ordinal = 9  # CU_POINTER_ATTRIBUTE_DEVICE_ORDINAL
    status = driver.cuPointerGetAttribute(ctypes.byref(ordinal), attribute_device_ordinal, ctypes.c_uint64(pointer))
    return f"cuda:{ordinal.value}" if status == 0 else "cuda:0"


def reexporter(values: Any) -> Callable[["wp.array"], Any]:
    """How a result becomes the caller's kind: the type's own ``from_dlpack``, else its library's, else a warp array."""
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


def as_table(out: "wp.array") -> "wp.array":
    """(N,) of vec3 as (N, 3) of scalars over the same memory; scalars as they are."""
    import warp as wp

    scalar = {wp.vec3f: wp.float32, wp.vec3d: wp.float64}.get(out.dtype)
    return out if scalar is None else reinterpreted(out, scalar, (*out.shape, 3))


def reinterpreted(array: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """The same contiguous memory under another type and shape; keeps its owner alive."""
    import warp as wp

    view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
    view._geokit_source = array
    return view
