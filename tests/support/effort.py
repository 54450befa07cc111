"""How much is tried: by default a share that meets each kind once, everything with ``./dev test --all``."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TypeVar

__all__ = ["ALL", "of_all", "spread"]

ALL = os.environ.get("GEOKIT_TEST_ALL") == "1"

_Value = TypeVar("_Value")


def of_all(some: _Value, everything: _Value) -> _Value:
    """The first, or the second where everything is tried."""
    return everything if ALL else some


def spread(values: Iterable[_Value], count: int) -> list[_Value]:
    """``count`` of a sweep's values in even steps, its first and its last among them; all where everything is tried."""
    found = list(values)
    if ALL or len(found) <= count:
        return found
    return [found[round(k * (len(found) - 1) / (count - 1))] for k in range(count)]
