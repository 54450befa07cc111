"""Operations on the voxels and tiles that a volume has: pruning and clipping."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import read_array
from geokit.errors import InputError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.tree.clip import clipped
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import dequantized, require_volume
from geokit.volume.tree.prune import pruned
from geokit.volume.tree.typed_tree import VALUE_TYPES


@needs(lambda volume, *_, **__: 200 * leaf_count(volume))
def prune(volume: SparseVolume, tolerance: float = 0.0) -> SparseVolume:
    """Replace nodes whose voxels are alike by tiles.

    A node becomes a tile if all its voxels share one state and their values lie within the tolerance. The tile takes
    their median (for vectors the middle one in lexicographic order). With tolerance 0 every voxel keeps its value and
    state. Vectors and colors are alike if each of their components is. In a mask only the states count, and the two
    values of a bool are never alike. Needs no OpenVDB.

    Args:
        volume: A grid of any type that holds values; quantized ones become float.
        tolerance: Largest difference of values in a tile, in the grid's units, not negative.
    Returns:
        Volume of the same type, class, name and metadata; ``volume`` itself where no node becomes a tile.
    Raises:
        InputError: volume is not a SparseVolume, or tolerance is negative or not finite.
        UnsupportedGridError: A grid of indices or points.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    tolerance = require_finite_scalar(tolerance, "tolerance")
    if tolerance < 0.0:
        raise InputError(f"tolerance: {tolerance} is negative; give the largest difference within a tile")
    return pruned(dequantized(volume), tolerance)


@needs(lambda volume, *_, **__: 5600 * leaf_count(volume))
def clip(volume: SparseVolume, bounds: ArrayLike) -> SparseVolume:
    """Keep the part of a volume inside a box; everything outside becomes inactive background.

    A voxel is inside if its center is, including the box's faces, under any affine transform. A level set is cut open:
    its surface ends at the box. (Its intersection with a level set of the box is closed.) Tiles that the box's faces
    cut become voxels there. Needs no OpenVDB, for any type.

    Args:
        volume: A grid of any type that holds values; quantized ones become float.
        bounds: Lower and upper corner [world], shape (2, 3).
    Returns:
        Volume of the same type, class, name and metadata.
    Raises:
        InputError: volume is not a SparseVolume, or bounds are not (2, 3), finite and in order.
        UnsupportedGridError: A grid of indices or points.
        DeviceMemoryError: The box cuts larger tiles than fit into memory.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    return clipped(dequantized(volume), require_box(bounds))


def require_box(bounds: Any) -> NDArray[np.float64]:
    """Lower and upper corner of a box, (2, 3).

    Raises:
        InputError: ``bounds`` are not (2, 3), finite and in order.
    """
    box = read_array(bounds, "bounds", np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise InputError(f"bounds: shape {box.shape} is not (2, 3) and finite; give lower and upper corner")
    if (box[0] > box[1]).any():
        raise InputError(f"bounds: lower corner {box[0].tolist()} exceeds the upper {box[1].tolist()}; swap them")
    return np.asarray(box)
