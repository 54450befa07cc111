"""Sparse volumes: files, sampling, and level sets from meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.volume.from_mesh import from_mesh
    from geokit.volume.io import inspect, load, load_all, save
    from geokit.volume.model import GridInfo, SparseVolume
    from geokit.volume.sample import gradient, sample

__all__ = ["GridInfo", "SparseVolume", "from_mesh", "gradient", "inspect", "load", "load_all", "sample", "save"]

make_lazy(
    __name__,
    {
        "GridInfo": "geokit.volume.model",
        "SparseVolume": "geokit.volume.model",
        "from_mesh": "geokit.volume.from_mesh",
        "gradient": "geokit.volume.sample",
        "inspect": "geokit.volume.io",
        "load": "geokit.volume.io",
        "load_all": "geokit.volume.io",
        "sample": "geokit.volume.sample",
        "save": "geokit.volume.io",
    },
)
