"""The extension ``_core``: file parsers in C++. It needs no OpenVDB, and is there wherever a compiler built geokit."""

from __future__ import annotations

import functools
import importlib
from types import ModuleType


@functools.cache
def parsers() -> ModuleType | None:
    """The extension; None where geokit was built without a compiler: callers then read in Python, more slowly."""
    try:
        return importlib.import_module("geokit.native._core")
    except ImportError:
        return None
