"""Checks of level-set operands, and bands of equal width for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from geokit.errors import InputError
from geokit.volume.level_set.band_widths import BAND_TOLERANCE, widths_of
from geokit.volume.level_set.redistance import redistance
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.tree.leaves import require_volume, uniform_voxel_size


def require_level_set(volume: Any, name: str) -> float:
    """Check for a level set with cubic voxels, and return its voxel size.

    Raises:
        InputError: It is no SparseVolume or no level set, its background is not positive and finite, or its
            voxels are not cubes.
        UnsupportedGridError: Its values are not real numbers.
    """
    require_volume(volume, name, ("float", "double"))
    if volume.info.grid_class != "level set":
        raise InputError(
            f"{name}: grid {volume.info.name!r} is of class {volume.info.grid_class}, not a level set; make one with "
            "from_mesh, or set its class if it holds signed distances"
        )
    voxel_size = uniform_voxel_size(volume, name)
    # Not a number fails both comparisons.
    if not (volume.info.background > 0.0 and float(volume.info.background) / voxel_size < np.inf):
        raise InputError(
            f"{name}: the background of grid {volume.info.name!r} is {volume.info.background} with voxels of "
            f"{voxel_size:g}; a level set's is the width of its band, a positive finite number"
        )
    return voxel_size


def with_band(volume: SparseVolume, voxel_size: float, half_width: float, *, device: Any = None) -> SparseVolume:
    """The level set with a band of another width on both sides; voxels that stay active keep their values."""
    if np.isclose(widths_of(volume, voxel_size), half_width, rtol=BAND_TOLERANCE, atol=0.0).all():
        return volume
    return redistance(volume, voxel_size, half_width, keeps_band=True, device=device)
