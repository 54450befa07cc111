"""Sweeps of the methods of points towards failure."""

from __future__ import annotations

from typing import Any

from geokit.accuracy.stability import points_search, points_shape
from geokit.accuracy.trials.model import Sweep

__all__ = ["points_sweeps"]


def points_sweeps(device: Any = None) -> list[Sweep]:
    """Sweeps of neighbor searches, normals, registration and densities.

    Args:
        device: Where the methods compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Sweeps with different names.
    """
    return [sweep for part in (points_search, points_shape) for sweep in part.SWEEPS.on(device)]
