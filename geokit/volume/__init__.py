"""Sparse volumes: files, sampling, and level sets from meshes."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__all__ = ["GridInfo", "SparseVolume", "from_mesh", "gradient", "inspect", "load", "load_all", "sample", "save"]

# Public name -> the module that defines it, imported when the name is first used.
_MODULES = {
    "GridInfo": "geokit.volume.model",
    "SparseVolume": "geokit.volume.model",
    "from_mesh": "geokit.volume.from_mesh",
    "gradient": "geokit.volume.sample",
    "inspect": "geokit.volume.io",
    "load": "geokit.volume.io",
    "load_all": "geokit.volume.io",
    "sample": "geokit.volume.sample",
    "save": "geokit.volume.io",
}

if TYPE_CHECKING:
    from geokit.volume.from_mesh import from_mesh
    from geokit.volume.io import inspect, load, load_all, save
    from geokit.volume.model import GridInfo, SparseVolume
    from geokit.volume.sample import gradient, sample


class _Package(ModuleType):
    """The package's own type: ``sample`` and ``from_mesh`` are functions in modules of the same names."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing such a module binds it here; users of the package mean the function.
        if isinstance(value, ModuleType) and name in _MODULES:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'geokit.volume' has no attribute '{name}'")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
