"""The leaves of a volume as arrays, and volumes from such arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import available_memory
from geokit.errors import DeviceMemoryError, InputError, UnsupportedGridError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.header import TREE_OFFSET, tree_header, voxel_size_of
from geokit.volume.nanovdb.layout import LAYOUTS
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.tree.openvdb_call import lift_factor, lifted_transform, lowered, operate, result_of

__all__ = [
    "LEAF_VOXELS",
    "QUANTISED",
    "Leaves",
    "assemble",
    "is_cubic",
    "leaves_of",
    "require_volume",
    "uniform_voxel_size",
    "voxelized",
]

QUANTISED = QUANTIZED
LEAF_VOXELS = 512
# A voxel of an active tile costs its value, its share of a mask and the same again while it is converted.
BYTES_PER_VOXEL = 16
# Edges of a voxel whose lengths or angles differ by less than this are those of a cube whose matrix was rounded.
CUBE_TOLERANCE = 1e-6


class Leaves(NamedTuple):
    """Leaves of a grid: first voxels (L, 3) int32 and packed active masks (L, 64) uint8."""

    origins: NDArray[np.int32]
    masks: NDArray[np.uint8]


def require_volume(volume: Any, name: str, types: tuple[str, ...] | None = None) -> SparseVolume:
    """``volume`` itself, if it is one, of one of ``types`` (quantised ones count as float).

    Raises:
        InputError: It is not a SparseVolume.
        UnsupportedGridError: Its type is none of them.
    """
    if not isinstance(volume, SparseVolume):
        raise InputError(f"{name}: {type(volume).__name__} is not a SparseVolume; load or make one first")
    grid_type = volume.info.grid_type
    if types is not None and ("float" if grid_type in QUANTISED else grid_type) not in types:
        raise UnsupportedGridError(
            f"{name}: grid {volume.info.name!r} is of type {grid_type}; this operation takes {', '.join(types)} grids, "
            "so convert it first"
        )
    return volume


def uniform_voxel_size(volume: SparseVolume, name: str) -> float:
    """Edge of a volume's cubic voxels [world].

    Raises:
        InputError: Voxels are no cubes: distances along the index axes are not those in the world.
    """
    if not is_cubic(volume.info.transform):
        raise InputError(
            f"{name}: the voxels of grid {volume.info.name!r} are not cubes; resample it with voxel_size= first"
        )
    return float(volume.info.voxel_size[0])


def is_cubic(transform: NDArray[np.float64]) -> bool:
    """Whether distances along the index axes are those in the world but for one factor; rotated and mirrored too."""
    shape = transform[:3, :3] / float(voxel_size_of(transform)[0])
    return bool(np.allclose(shape.T @ shape, np.eye(3), rtol=0.0, atol=CUBE_TOLERANCE))


def voxelized(volume: SparseVolume) -> SparseVolume:
    """The volume with leaves in place of active tiles and floats in place of quantised values; itself without either.

    Raises:
        DeviceMemoryError: The tiles hold more voxels than there is memory for.
    """
    if volume.info.grid_type not in QUANTISED and _leaf_active_count(volume) == volume.info.active_voxel_count:
        return volume
    need, have = BYTES_PER_VOXEL * (volume.info.active_voxel_count or 0), available_memory.available_host()
    if need > have:
        raise DeviceMemoryError(
            f"volume: the active tiles of grid {volume.info.name!r} need about {need >> 20} MiB as voxels, of "
            f"{have >> 20} MiB free; clip it, or resample it at a larger voxel_size"
        )
    from geokit.native import operations

    result: SparseVolume = operate(operations.voxelized, volume)
    return result


def leaves_of(volume: SparseVolume) -> Leaves:
    """Origins and masks of a volume's leaves, in their order in the buffer. Not for quantised grids."""
    tree = tree_header(volume.nanovdb)
    count = int(tree["node_count"][0])
    size = LAYOUTS[volume.info.grid_type].leaf_size
    begin = TREE_OFFSET + int(tree["node_offset"][0])
    if not count:
        return Leaves(np.empty((0, 3), np.int32), np.empty((0, 64), np.uint8))
    corners = np.ndarray((count, 3), "<i4", volume.nanovdb, begin, (size, 4))
    masks = np.ndarray((count, 64), np.uint8, volume.nanovdb, begin + 16, (size, 1))
    # A leaf stores the first voxel of its active box; its own first voxel is the multiple of eight below.
    return Leaves(np.ascontiguousarray(corners & ~np.int32(7)), np.ascontiguousarray(masks))


def assemble(
    leaves: Leaves,
    values: NDArray[Any],
    like: SparseVolume,
    *,
    background: Any = 0.0,
    grid_class: str = "unknown",
    transform: NDArray[np.float64] | None = None,
) -> SparseVolume:
    """A volume from leaves and their values (L, 512) or (L, 512, 3), with name and metadata of ``like``.

    Leaves without an active voxel are left out.
    """
    from geokit.native import operations

    kept: Any = leaves.masks.any(axis=1)
    if kept.all():
        kept = slice(None)  # without a copy
    matrix = like.info.transform if transform is None else transform
    factor = lift_factor(matrix)
    buffer = operations.from_leaves(
        leaves.origins[kept],
        values[kept],
        leaves.masks[kept],
        background=background,
        transform=lifted_transform(matrix, factor),
        name=like.info.name,
        grid_class=grid_class,
    )
    return result_of(lowered(buffer, factor), like)


def _leaf_active_count(volume: SparseVolume) -> int:
    if volume.info.grid_type not in LAYOUTS:
        return -1
    return int(np.unpackbits(leaves_of(volume).masks).sum(dtype=np.int64))
