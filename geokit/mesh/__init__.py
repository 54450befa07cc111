"""Triangle meshes: files, audit, queries."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__all__ = ["MeshAudit", "MeshPart", "Surface", "TriangleMesh", "audit", "from_volume", "load", "save"]

# Public name -> the module that defines it, imported when the name is first used.
_MODULES = {
    "MeshAudit": "geokit.mesh.audit",
    "MeshPart": "geokit.mesh.model",
    "Surface": "geokit.mesh.surface",
    "TriangleMesh": "geokit.mesh.model",
    "audit": "geokit.mesh.audit",
    "from_volume": "geokit.mesh.from_volume",
    "load": "geokit.mesh.io",
    "save": "geokit.mesh.io",
}

if TYPE_CHECKING:
    from geokit.mesh.audit import MeshAudit, audit
    from geokit.mesh.from_volume import from_volume
    from geokit.mesh.io import load, save
    from geokit.mesh.model import MeshPart, TriangleMesh
    from geokit.mesh.surface import Surface


class _Package(ModuleType):
    """The package's own type: ``audit`` and ``from_volume`` are functions in modules of the same names."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing such a module binds it here; users of the package mean the function.
        if isinstance(value, ModuleType) and name in _MODULES:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'geokit.mesh' has no attribute '{name}'")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
