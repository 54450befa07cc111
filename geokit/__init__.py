"""Geometry on sparse volumes and meshes: closest points, rays, signed distance fields and neighbours."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from geokit import errors
from geokit.errors import (
    DeviceMemoryError,
    FileAccessError,
    FileFormatError,
    GeokitError,
    InputError,
    MissingDependencyError,
    UnsupportedGridError,
)

if TYPE_CHECKING:
    from geokit import accuracy, mesh, points, render, threads, volume

__version__ = "0.1.0"

__all__ = [
    "DeviceMemoryError",
    "FileAccessError",
    "FileFormatError",
    "GeokitError",
    "InputError",
    "MissingDependencyError",
    "UnsupportedGridError",
    "__version__",
    "accuracy",
    "errors",
    "mesh",
    "points",
    "render",
    "threads",
    "volume",
]

# Loaded on first use: a program that only reads meshes should not wait for the rest.
_NAMESPACES = frozenset({"accuracy", "mesh", "points", "render", "threads", "volume"})


def __getattr__(name: str) -> Any:
    if name in _NAMESPACES:
        return importlib.import_module(f"geokit.{name}")
    raise AttributeError(f"module 'geokit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
