"""Operations on the voxels and tiles that a volume has: pruning, clipping, connected components."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from geokit.core import available_memory
from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.level_set.operands import require_level_set
from geokit.volume.nanovdb.types import OPENVDB_TOOL_TYPES, QUANTIZED
from geokit.volume.tree.clip import clipped
from geokit.volume.tree.leaves import dequantized, require_volume
from geokit.volume.tree.openvdb_call import call_openvdb
from geokit.volume.tree.prune import pruned
from geokit.volume.tree.segment import segmented
from geokit.volume.tree.typed_tree import VALUE_TYPES

__all__ = ["clip", "prune", "segment"]

# Types that OpenVDB's library cannot segment, or does not know at all.
OPENVDB_LACKS = tuple(name for name in VALUE_TYPES if name not in OPENVDB_TOOL_TYPES)


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
        Volume of the same type, class, name and metadata.
    Raises:
        InputError: volume is not a SparseVolume, or tolerance is negative or not finite.
        UnsupportedGridError: A grid of indices or points.
    """
    require_volume(volume, "volume", VALUE_TYPES)
    tolerance = require_finite_scalar(tolerance, "tolerance")
    if tolerance < 0.0:
        raise InputError(f"tolerance: {tolerance} is negative; give the largest difference within a tile")
    return pruned(dequantized(volume), tolerance)


def clip(volume: SparseVolume, bounds: Any) -> SparseVolume:
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
    try:
        box = np.asarray(bounds, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"bounds: {bounds!r} is not a table of numbers; give lower and upper corner") from error
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise InputError(f"bounds: shape {box.shape} is not (2, 3) and finite; give lower and upper corner")
    if (box[0] > box[1]).any():
        raise InputError(f"bounds: lower corner {box[0].tolist()} exceeds the upper {box[1].tolist()}; swap them")
    return clipped(dequantized(volume), box)


def segment(volume: SparseVolume) -> list[SparseVolume]:
    """Split a volume into its connected components, largest first.

    Level sets of real values are split by their inside, connected over faces: a hollow body is one component. Each
    component has its own band. Voxels keep their values, except those between bodies whose bands meet, which get the
    distance to the component's own surface (to 0.1 voxel, next to sharp edges to 0.5). Other grids are split by their
    active voxels. Needs OpenVDB.

    Args:
        volume: A grid of any type that holds values; quantized ones become float.
    Returns:
        Volumes with the name, class and metadata of the whole, by number of active voxels, descending. The list is
            empty if the volume has no active voxels.
    Raises:
        InputError: volume is not a SparseVolume, or is a level set whose voxels are not cubes.
        UnsupportedGridError: A grid of indices or points.
        DeviceMemoryError: The inside of a level set has more voxels than can be labeled.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    from geokit.native import operations

    require_volume(volume, "volume", VALUE_TYPES)
    if not volume.info.active_voxel_count:
        return []
    is_distance = volume.info.grid_class == "level set" and volume.info.grid_type in ("float", "double", *QUANTIZED)
    voxel_size = require_level_set(volume, "volume") if is_distance else 1.0

    def parts_of(grid: SparseVolume) -> list[SparseVolume]:
        parts: list[SparseVolume] = call_openvdb(
            operations.segment, grid, voxel_size=voxel_size, memory_limit=available_memory.available_host()
        )
        return parts

    if volume.info.grid_type in OPENVDB_LACKS and volume.info.grid_type != "mask":
        return segmented(volume, parts_of)
    return [_marked(part, volume) for part in parts_of(volume)]


def _marked(result: SparseVolume, like: SparseVolume) -> SparseVolume:
    """The result with the metadata mark of integer vectors that the whole has, since no value has changed."""
    if "geokit:value_type" not in like.info.metadata or result.info.grid_type != like.info.grid_type:
        return result
    return SparseVolume(result.nanovdb, replace(result.info, metadata=like.info.metadata))
