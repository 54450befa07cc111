"""Removes walls between bodies that touch, from level sets that were combined voxel by voxel.

The minimum of two distances is at most as deep inside as the nearer operand's surface. Where surfaces of two operands
touch, back to back, or overlap by less than a few voxels, values fall towards that wall and rise again, and on the
lattice they are 0. It is no boundary: there the result is as deep as its isosurface is far. So it is outside of a
difference or an intersection: that is inside of the union of complements.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.mesh.model.triangle_mesh import TriangleMesh
from geokit.mesh.surfaces.surface import Surface
from geokit.points.neighbors.neighbor_grid import NeighborGrid
from geokit.volume.at_points.sample import sample
from geokit.volume.isosurface.surface_nets import surface_nets
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import grid_nodes, set_bits, slot_places
from geokit.volume.tree.leaves import assemble, dequantized, leaves_of

# Voxels this near to both surfaces are looked at [voxels]; of a wall in any direction some are.
NEAR = 1.0
# Surfaces whose normals have a product below this are back to back.
OPPOSED = -0.8
# Between such surfaces there is a gap, no contact, if the distances add up to more than this [voxels].
GAP = 0.01
# Least depth of voxels at a wall [voxels]: enough for a sign.
SURE_DEPTH = 0.5
# Values that differ by less from distances to the isosurface are kept [voxels]: they are exact, those are not.
KEPT_WITHIN = 0.5

Operand = tuple[SparseVolume, float]


def without_false_walls(
    result: SparseVolume, one: Operand, other: Operand, voxel_size: float, side: float
) -> SparseVolume:
    """The level set without walls that are no boundary; itself if there are none.

    Args:
        result: What two operands on its lattice were combined to.
        one: The first operand, and the factor, 1 or -1, with which the result is a union.
        other: The second one.
        voxel_size: Edge of a voxel [world].
        side: 1 if the result is that union, -1 if its complement.
    """
    wall = _wall_voxels(one, other, voxel_size)
    if not len(wall):
        return result
    leaf, leaves = grid_nodes(result.nanovdb).leaf, leaves_of(result)
    values = np.array(leaf.values)
    node, slot = set_bits(leaves.masks)
    at = leaves.origins[node] + slot_places(slot, 8).astype(np.int32)
    depth = -side * values[node, slot].astype(np.float64) / voxel_size
    # The wall's own voxels may have the value 0: first they get a sign.
    is_wall = _isin(at, wall)
    depth[is_wall] = np.maximum(depth[is_wall], SURE_DEPTH)
    values[node, slot] = -side * depth * voxel_size
    width = float(result.info.background) / voxel_size
    near = np.flatnonzero(depth > 0.0)
    near = near[NeighborGrid(wall.astype(np.float64), width + 1.0, device="cpu").count(at[near].astype(np.float64)) > 0]
    opened = assemble(
        leaves, values, result, background=leaf.layout.background.type(width * voxel_size), grid_class="level set"
    )
    corners, faces = surface_nets(
        opened, 0.0, launcher.resolve_device("cpu"), turned=False, sharp=True, transform=np.eye(4)
    )
    if not len(faces):
        return opened
    boundary = Surface(TriangleMesh(corners.numpy(), faces.numpy().reshape(-1, 3)), device="cpu")
    found = np.asarray(boundary.closest_point(at[near].astype(np.float64)).distance)
    deeper = found > depth[near] + KEPT_WITHIN
    near, found = near[deeper], found[deeper]
    values[node[near], slot[near]] = -side * np.minimum(found, width) * voxel_size
    active = np.unpackbits(leaves.masks, axis=1, bitorder="little")
    beyond = near[found >= width]
    active[node[beyond], slot[beyond]] = 0
    masks = np.packbits(active, axis=1, bitorder="little")
    return assemble(
        leaves._replace(masks=masks), values, result, background=result.info.background, grid_class="level set"
    )


def _wall_voxels(one: Operand, other: Operand, voxel_size: float) -> NDArray[np.int32]:
    """Index coordinates of the voxels beside a wall, (W, 3)."""
    volume, sign = dequantized(one[0]), one[1]
    leaf, leaves = grid_nodes(volume.nanovdb).leaf, leaves_of(volume)
    node, slot = set_bits(leaves.masks)
    found = leaf.values[node, slot]
    near = np.abs(found) <= NEAR * voxel_size
    at = leaves.origins[node[near]] + slot_places(slot[near], 8).astype(np.int32)
    value = sign * found[near].astype(np.float64)
    beyond = other[1] * _read(other[0], at)
    near = (np.abs(beyond) <= NEAR * voxel_size) & (value + beyond <= GAP * voxel_size)
    at = at[near]
    if not len(at):
        return at
    slopes = [factor * _differences(each, at) / voxel_size for each, factor in (one, other)]
    return at[(slopes[0] * slopes[1]).sum(axis=1) < OPPOSED]


def _differences(volume: SparseVolume, at: NDArray[np.int32]) -> NDArray[np.float64]:
    """Half of the differences between the neighbors of voxels on both sides, (N, 3)."""
    steps = np.eye(3, dtype=np.int32)
    return np.stack([0.5 * (_read(volume, at + step) - _read(volume, at - step)) for step in steps], axis=1)


def _read(volume: SparseVolume, at: NDArray[np.int32]) -> NDArray[np.float64]:
    return np.asarray(sample(volume, at.astype(np.float64), order=0, space="index", device="cpu"))


def _isin(rows: NDArray[np.int32], of: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which rows of three are among others."""
    low = of.min(axis=0)
    size = (of.max(axis=0) - low + 1).astype(np.int64)
    inside = ((rows >= low) & (rows - low < size)).all(axis=1)
    number = [(part - low).astype(np.int64) @ [size[1] * size[2], size[2], 1] for part in (rows[inside], of)]
    found = np.zeros(len(rows), bool)
    found[inside] = np.isin(number[0], number[1])
    return found
