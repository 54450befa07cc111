"""Zero-copy exchange of arrays with other libraries, through DLPack and the CUDA array interface."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = ["as_table", "exporter_like", "import_array", "is_exporter", "reinterpreted"]


def is_exporter(values: Any) -> bool:
    # NumPy reads everything without these protocols (pandas columns, memory views, nested lists).
    return hasattr(values, "__dlpack__") or hasattr(values, "__cuda_array_interface__")


def import_array(values: Any, name: str) -> "wp.array":
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
    # The protocol does not name the GPU; the driver knows it.
    import ctypes

    driver = ctypes.CDLL("libcuda.so.1")
    ordinal = ctypes.c_int(-1)
    attribute_device_ordinal = 9  # CU_POINTER_ATTRIBUTE_DEVICE_ORDINAL
    status = driver.cuPointerGetAttribute(ctypes.byref(ordinal), attribute_device_ordinal, ctypes.c_uint64(pointer))
    return f"cuda:{ordinal.value}" if status == 0 else "cuda:0"


def exporter_like(values: Any) -> Callable[["wp.array"], Any]:
    """A function that converts a result into the kind of array that ``values`` is.

    It uses ``from_dlpack`` of the array type, else of the type's library; without either it returns a warp array.
    """
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
    """View an (N,) array of vec3 as (N, 3) scalars over the same memory; return scalar arrays unchanged."""
    import warp as wp

    scalar = {wp.vec3f: wp.float32, wp.vec3d: wp.float64}.get(out.dtype)
    return out if scalar is None else reinterpreted(out, scalar, (*out.shape, 3))


def reinterpreted(array: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """View contiguous memory under another type and shape; the view keeps the owner alive."""
    import warp as wp

    view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
    view._geokit_source = array
    return view
