"""Converts errors of the extension and of the worker to geokit's exceptions."""

from __future__ import annotations

from typing import Any, NoReturn

from geokit.core.files import in_one_line
from geokit.errors import DeviceMemoryError, FileAccessError, FileFormatError, InputError, UnsupportedGridError


def raise_failure(error: dict[str, Any], what: str, is_argument: bool = False) -> NoReturn:
    """Raise the exception for an error that the C++ code reports.

    Args:
        error: "kind" and "message", as in src/bridge.h; for a missing grid also the "names" of the existing ones.
        what: The file or the argument at fault.
        is_argument: Whether the caller passed the data itself rather than a file name.
    """
    kind, message = error["kind"], in_one_line(error["message"])
    if kind == "missing":
        there = ", ".join(repr(name) for name in error["names"])
        raise InputError(f"{what}: {message}; the file holds {there}")
    if kind == "points":
        raise UnsupportedGridError(f"{what}: {message}; load them with geokit.points.load")
    if kind == "unsupported":
        raise UnsupportedGridError(f"{what}: {message}; leave it out or convert it in the program that made it")
    if kind == "access":
        raise FileAccessError(f"{what}: {message}; check the path, its permissions and the disk")
    if kind == "memory" and is_argument:
        raise DeviceMemoryError(f"{what}: {message}")
    if kind == "memory":
        raise FileFormatError(f"{what}: {message}; the file is damaged, or pass a larger memory_limit")
    if kind == "damaged" and not is_argument:
        raise FileFormatError(f"{what}: not a sound .vdb file: {message}; restore it from its source")
    raise InputError(f"{what}: {message}")
