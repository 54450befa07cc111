"""Sweeps of the methods of volumes towards failure."""

from __future__ import annotations

from typing import Any

from geokit.accuracy.stability import volume_change, volume_mesh, volume_rays, volume_sample
from geokit.accuracy.trials.model import Sweep

__all__ = ["volume_sweeps"]


def volume_sweeps(device: Any = None) -> list[Sweep]:
    """Sweeps of level sets of meshes, isosurfaces, sampling, codecs, rays, fog and level-set operations.

    Args:
        device: Where the methods compute: "cpu", "cuda:0", ...; None for the first GPU, else the CPU.
    Returns:
        Sweeps with different names. Those of methods that need OpenVDB are left out if geokit was built without it.
    """
    from geokit import native

    smoothing = [volume_change.SMOOTHING] if native.available() else []
    parts = [volume_mesh.SWEEPS, volume_sample.SWEEPS, volume_rays.SWEEPS, volume_change.SWEEPS, *smoothing]
    return [sweep for part in parts for sweep in part.on(device)]
