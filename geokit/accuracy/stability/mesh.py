"""Sweeps of the methods of meshes towards failure."""

from __future__ import annotations

from typing import Any

from geokit.accuracy.stability import mesh_distance, mesh_rays, mesh_repair, mesh_sign
from geokit.accuracy.trials.model import Sweep

__all__ = ["mesh_sweeps"]


def mesh_sweeps(device: Any = "cpu") -> list[Sweep]:
    """Sweeps of the methods of :mod:`geokit.mesh`, each with its promise.

    Closest points, signed distances, signs and rays are swept by position and size of the mesh, slivers, holes, flips,
    copies, overlaps, edges, vertices and grazing angles; Hausdorff distances, orientation, merging and audits by the
    inputs that break them. Answers are compared with analytic shapes and float64 brute force. Each promise leaves at
    least a factor of four to the values measured on several seeds.

    Args:
        device: Where the methods run: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Sweeps in the order of the report.
    Example:
        >>> sweep = mesh_sweeps()[0]
        >>> sweep.name, bool(sweep.ask(1e8).errors.max() <= sweep.envelope.error)
        ('closest_point_origin', True)
    """
    parts = (mesh_distance, mesh_sign, mesh_rays, mesh_repair)
    return [sweep for part in parts for sweep in part.SWEEPS.on(device)]
