"""How much is tried: by default a share that meets each kind once, everything with ``./dev test --all``."""

from __future__ import annotations

import os
from typing import TypeVar

__all__ = ["ALL", "of_all"]

ALL = os.environ.get("GEOKIT_TEST_ALL") == "1"

_Value = TypeVar("_Value")


def of_all(some: _Value, everything: _Value) -> _Value:
    """The first, or the second where everything is tried."""
    return everything if ALL else some
