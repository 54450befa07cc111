"""Point sets: neighbours within a radius, and reading and writing point files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.points.io import PointCloud, load, load_rays, save
    from geokit.points.neighbors import NeighborGrid, Neighbors

__all__ = ["NeighborGrid", "Neighbors", "PointCloud", "load", "load_rays", "save"]

make_lazy(
    __name__,
    {
        "NeighborGrid": "geokit.points.neighbors",
        "Neighbors": "geokit.points.neighbors",
        "PointCloud": "geokit.points.io",
        "load": "geokit.points.io",
        "load_rays": "geokit.points.io",
        "save": "geokit.points.io",
    },
)
