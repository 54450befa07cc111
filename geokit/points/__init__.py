"""Point sets: neighbours within a radius, and reading and writing point files."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geokit.points.io import PointCloud, load, load_rays, save
    from geokit.points.neighbors import NeighborGrid, Neighbors

__all__ = ["NeighborGrid", "Neighbors", "PointCloud", "load", "load_rays", "save"]

# Where each public name lives; a module is read when one of its names is first asked for.
_MODULES = {
    "NeighborGrid": "geokit.points.neighbors",
    "Neighbors": "geokit.points.neighbors",
    "PointCloud": "geokit.points.io",
    "load": "geokit.points.io",
    "load_rays": "geokit.points.io",
    "save": "geokit.points.io",
}


def __getattr__(name: str) -> Any:
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'geokit.points' has no attribute {name!r}")
    value = getattr(importlib.import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
