"""Leaves of a volume as arrays, and volumes built from such arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import HEAD_SIZE, grid_class_code, grid_header, voxel_size_of
from geokit.volume.nanovdb.layout import GRID_TYPES, LAYOUTS, GridLayout
from geokit.volume.nanovdb.nodes import grid_nodes, set_bits
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.tree.device_leaves import build_leaves
from geokit.volume.tree.estimates import counts_of, require_host_room
from geokit.volume.tree.flood_signs import with_signs
from geokit.volume.tree.grid_head import GridHead, result_head, volume_from_buffer
from geokit.volume.tree.leaf_codecs import LeafReader, write_floats
from geokit.volume.tree.retype_tree import retype_tree
from geokit.volume.tree.typed_tree import tree_of, tree_of_leaves, voxelized_tree
from geokit.volume.tree.typed_writer import build_grid, rebuilt

LEAF_VOXELS = 512
# Edges of a voxel whose lengths or angles differ by less than this belong to a cube whose matrix was rounded.
CUBE_TOLERANCE = 1e-6


class Leaves(NamedTuple):
    """Leaves of a grid: first voxels (L, 3) int32 and packed active masks (L, 64) uint8."""

    origins: NDArray[np.int32]
    masks: NDArray[np.uint8]


def require_volume(volume: Any, name: str, types: tuple[str, ...] | None = None) -> SparseVolume:
    """Return ``volume`` if it is a SparseVolume of one of ``types`` (quantized ones count as float).

    Raises:
        InputError: It is not a SparseVolume.
        UnsupportedGridError: It has another type.
    """
    if not isinstance(volume, SparseVolume):
        raise InputError(f"{name}: {type(volume).__name__} is not a SparseVolume; load or make one first")
    grid_type = volume.info.grid_type
    if types is not None and ("float" if grid_type in QUANTIZED else grid_type) not in types:
        raise UnsupportedGridError(
            f"{name}: grid {volume.info.name!r} is of type {grid_type}; this operation takes {', '.join(types)} grids, "
            "so convert it first"
        )
    return volume


def uniform_voxel_size(volume: SparseVolume, name: str) -> float:
    """Edge length of a volume's cubic voxels [world].

    Raises:
        InputError: The voxels are not cubes: distances along the index axes differ from those in the world.
    """
    if not is_cubic(volume.info.transform):
        raise InputError(
            f"{name}: the voxels of grid {volume.info.name!r} are not cubes; resample it with voxel_size= first"
        )
    return float(volume.info.voxel_size[0])


def is_cubic(transform: NDArray[np.float64]) -> bool:
    """Whether index distances equal world distances up to one factor; rotated and mirrored voxels too."""
    shape = transform[:3, :3] / float(voxel_size_of(transform)[0])
    return bool(np.allclose(shape.T @ shape, np.eye(3), rtol=0.0, atol=CUBE_TOLERANCE))


def dequantized(volume: SparseVolume) -> SparseVolume:
    """Convert quantized values to floats; returns the volume itself if it has none.

    Raises:
        FileFormatError: The buffer is not a valid grid.
        InputError: A value is not finite.
        DeviceMemoryError: The floats do not fit into memory.
    """
    if volume.info.grid_type not in QUANTIZED:
        return volume
    buffer = volume.nanovdb
    check_volume(volume)
    reader = LeafReader(buffer)
    layout = LAYOUTS["float"]
    require_host_room(reader.count * layout.leaf_size, f"volume: the float values of grid {volume.info.name!r}")
    retyped = retype_tree(buffer, GRID_TYPES.index("float"), np.full(reader.count, layout.leaf_size))
    write_floats(reader, retyped)
    grid_header(retyped.buffer)["checksum"] = partial_checksum(retyped.buffer[:HEAD_SIZE], retyped.buffer)
    return volume_from_buffer(retyped.buffer, volume)


def voxelized(volume: SparseVolume) -> SparseVolume:
    """Convert active tiles to leaves and quantized values to floats; returns the volume itself if it has neither.

    Raises:
        DeviceMemoryError: The tiles hold more voxels than fit into memory.
    """
    volume = dequantized(volume)
    if volume.info.grid_type in LAYOUTS and not counts_of(volume).has_tiles:
        return volume
    return rebuilt(voxelized_tree(tree_of(volume), volume.info.name), volume)


def leaves_of(volume: SparseVolume) -> Leaves:
    """Origins and masks of a volume's leaves, in their order in the buffer. Not for quantized grids.

    Raises:
        FileFormatError: The buffer is not a valid grid.
    """
    check_volume(volume)
    leaf = grid_nodes(volume.nanovdb, LAYOUTS[volume.info.grid_type]).leaf
    return Leaves(leaf.origins, np.ascontiguousarray(leaf.value_mask))


def value_places(volume: SparseVolume) -> NDArray[np.int64]:
    """Place of each active value of a float or double grid in its buffer, in units of a value, (A,)."""

    def find() -> NDArray[np.int64]:
        leaf = grid_nodes(volume.nanovdb).leaf
        size = leaf.layout.background.itemsize
        node, slot = set_bits(np.ascontiguousarray(leaf.value_mask))
        return np.asarray((leaf.begin + leaf.table + node * leaf.size) // size + slot)

    return volume._cache.find("places of values", find)


def assemble(
    leaves: Leaves,
    values: NDArray[Any],
    like: SparseVolume,
    *,
    background: Any = 0.0,
    grid_class: str = "unknown",
    transform: NDArray[np.float64] | None = None,
) -> SparseVolume:
    """Build a volume from leaves and their values (L, 512) or (L, 512, 3), with name and metadata of ``like``.

    Leaves without an active voxel are left out.
    """
    kept: Any = leaves.masks.any(axis=1)
    if kept.all():
        kept = slice(None)  # avoids a copy
    rows = leaves.origins[kept], leaves.masks[kept], values[kept]
    layout = _real_layout(values)
    head = result_head(like, layout, background, grid_class, like.info.transform if transform is None else transform)
    return volume_from_buffer(build_real_grid(head, *rows), like)


def build_real_grid(
    head: GridHead, origins: NDArray[np.int32], masks: NDArray[np.uint8], values: NDArray[Any]
) -> NDArray[np.uint8]:
    """Build a grid of floats, doubles or vectors of them; empty regions inside a level set get ``head.inside``.

    Args:
        head: Specification of the grid.
        origins: First voxel of each leaf, (L, 3), without repetitions.
        masks: Active voxels of each leaf, (L, 64).
        values: Values of each leaf, (L, 512) or (L, 512, C).
    """
    signed = head.options.grid_class == grid_class_code("level set")
    if head.layout.name == "float" and not head.has_long_name:
        return build_leaves(head, origins, values, masks, signed=signed)
    tree = tree_of_leaves(head.layout, head.background, origins, masks, values)
    return build_grid(with_signs(tree, head.inside) if signed else tree, head)


def _real_layout(values: NDArray[Any]) -> GridLayout:
    """Layout of grids of floats or doubles (L, 512), or vectors of them (L, 512, 3)."""
    is_double = values.dtype == np.float64
    if values.ndim == 2:
        return LAYOUTS["double" if is_double else "float"]
    return LAYOUTS["vec3d" if is_double else "vec3f"]
