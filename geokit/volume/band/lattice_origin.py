"""The lattice of a new level set and the range of its values, for all builders of level sets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop import user_arrays
from geokit.errors import InputError

# Beyond this index the float32 coordinates of warp's own volume functions are coarser than 1/16 voxel.
LARGEST_CENTERED_INDEX = 1 << 20
LEAF = 8
FLOAT32 = np.finfo(np.float32)


def index_translation(bounds: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Position [world] of index 0: the origin; for boxes far from it, the multiple of 8 voxels nearest their middle.

    Args:
        bounds: Lower and upper corner [world], shape (2, 3).
        voxel_size: Edge length of a voxel [world].
    """
    # Voxel sizes that are too small overflow here; such grids are refused later for their number of voxels.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.abs(bounds).max() / voxel_size < LARGEST_CENTERED_INDEX:
            return np.zeros(3)
        tile = LEAF * voxel_size
        return np.asarray(np.round((0.5 * bounds[0] + 0.5 * bounds[1]) / tile) * tile)


def checked_band(voxel_size: Any, half_width: Any) -> tuple[float, float]:
    """Check the voxel size and half width of a narrow band, and return them as floats.

    Raises:
        InputError: One is not a finite number, the voxel size is not positive, the half width is less than a voxel, or
            the distances of the band are not normal float32 numbers.
    """
    voxel_size = user_arrays.require_finite_scalar(voxel_size, "voxel_size", low=0.0)
    half_width = user_arrays.require_finite_scalar(half_width, "half_width")
    if half_width < 1.0:
        raise InputError(f"half_width: {half_width} voxels cannot hold a sign change on each side; use at least 1")
    # A thousandth of a voxel should still be a normal float32 number.
    if not 1e3 * float(FLOAT32.tiny) < voxel_size or not half_width * voxel_size < float(FLOAT32.max):
        raise InputError(
            f"voxel_size: distances within {half_width:g} voxels of {voxel_size:g} are not float32 numbers; scale the "
            "input"
        )
    return voxel_size, half_width
