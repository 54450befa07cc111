"""Sparse volumes: files, sampling, rays, level sets from and to other things, and operations on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit._lazy import make_lazy

if TYPE_CHECKING:
    from geokit.volume.active import active_at
    from geokit.volume.adaptive import AdaptiveSDF, adaptive_from_mesh, load_adaptive
    from geokit.volume.csg import difference, intersection, union
    from geokit.volume.curvature import Curvatures, curvature, hessian
    from geokit.volume.dense import DenseGrid, from_dense, to_dense
    from geokit.volume.differential import curl, divergence, gradient_field, laplacian
    from geokit.volume.filters import smooth
    from geokit.volume.from_channel import channel_names, from_channel
    from geokit.volume.from_function import from_function
    from geokit.volume.from_mesh import MeshBand, from_mesh, from_mesh_with_triangles
    from geokit.volume.from_points import from_points
    from geokit.volume.integrate import Transmittance, integrate
    from geokit.volume.io import inspect, load, load_all, save
    from geokit.volume.model import GridInfo, SparseVolume
    from geokit.volume.morphology import closing, dilate, erode, offset, opening, renormalize
    from geokit.volume.plan import PlannedField, plan
    from geokit.volume.quantize import quantize
    from geokit.volume.raycast import VolumeHits, raycast
    from geokit.volume.resample import resample
    from geokit.volume.sample import gradient, sample
    from geokit.volume.statistics import Statistics, statistics
    from geokit.volume.topology import clip, prune, segment

__all__ = [
    "AdaptiveSDF",
    "Curvatures",
    "DenseGrid",
    "GridInfo",
    "MeshBand",
    "PlannedField",
    "SparseVolume",
    "Statistics",
    "Transmittance",
    "VolumeHits",
    "active_at",
    "adaptive_from_mesh",
    "channel_names",
    "clip",
    "closing",
    "curl",
    "curvature",
    "difference",
    "dilate",
    "divergence",
    "erode",
    "from_channel",
    "from_dense",
    "from_function",
    "from_mesh",
    "from_mesh_with_triangles",
    "from_points",
    "gradient",
    "gradient_field",
    "hessian",
    "inspect",
    "integrate",
    "intersection",
    "laplacian",
    "load",
    "load_adaptive",
    "load_all",
    "offset",
    "opening",
    "plan",
    "prune",
    "quantize",
    "raycast",
    "renormalize",
    "resample",
    "sample",
    "save",
    "segment",
    "smooth",
    "statistics",
    "to_dense",
    "union",
]

make_lazy(
    __name__,
    {
        "AdaptiveSDF": "geokit.volume.adaptive",
        "Curvatures": "geokit.volume.curvature",
        "DenseGrid": "geokit.volume.dense",
        "GridInfo": "geokit.volume.model",
        "MeshBand": "geokit.volume.from_mesh",
        "PlannedField": "geokit.volume.plan",
        "SparseVolume": "geokit.volume.model",
        "Statistics": "geokit.volume.statistics",
        "Transmittance": "geokit.volume.integrate",
        "VolumeHits": "geokit.volume.raycast",
        "active_at": "geokit.volume.active",
        "adaptive_from_mesh": "geokit.volume.adaptive",
        "channel_names": "geokit.volume.from_channel",
        "clip": "geokit.volume.topology",
        "closing": "geokit.volume.morphology",
        "curl": "geokit.volume.differential",
        "curvature": "geokit.volume.curvature",
        "difference": "geokit.volume.csg",
        "dilate": "geokit.volume.morphology",
        "divergence": "geokit.volume.differential",
        "erode": "geokit.volume.morphology",
        "from_channel": "geokit.volume.from_channel",
        "from_dense": "geokit.volume.dense",
        "from_function": "geokit.volume.from_function",
        "from_mesh": "geokit.volume.from_mesh",
        "from_mesh_with_triangles": "geokit.volume.from_mesh",
        "from_points": "geokit.volume.from_points",
        "gradient": "geokit.volume.sample",
        "gradient_field": "geokit.volume.differential",
        "hessian": "geokit.volume.curvature",
        "inspect": "geokit.volume.io",
        "integrate": "geokit.volume.integrate",
        "intersection": "geokit.volume.csg",
        "laplacian": "geokit.volume.differential",
        "load": "geokit.volume.io",
        "load_adaptive": "geokit.volume.adaptive",
        "load_all": "geokit.volume.io",
        "offset": "geokit.volume.morphology",
        "opening": "geokit.volume.morphology",
        "plan": "geokit.volume.plan",
        "prune": "geokit.volume.topology",
        "quantize": "geokit.volume.quantize",
        "raycast": "geokit.volume.raycast",
        "renormalize": "geokit.volume.morphology",
        "resample": "geokit.volume.resample",
        "sample": "geokit.volume.sample",
        "save": "geokit.volume.io",
        "segment": "geokit.volume.topology",
        "smooth": "geokit.volume.filters",
        "statistics": "geokit.volume.statistics",
        "to_dense": "geokit.volume.dense",
        "union": "geokit.volume.csg",
    },
)
