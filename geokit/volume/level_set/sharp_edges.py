"""Distances of an eroded body beyond its sharp edges: those from the body behind tangent planes at the edge."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.scan import prefix_sum
from geokit.volume.level_set.leaf_neighbors import LinkedLeaves

if TYPE_CHECKING:
    import warp as wp

__all__ = ["hold_beyond_edges"]

GRAIN = 64
# Share of sound voxels close to the surface with which a level set counts as one of distances.
LEAST_SOUND = 0.35


def hold_beyond_edges(
    leaves: LinkedLeaves,
    beside: "wp.array",
    field: tuple[float, float, float],
    half_width: float,
    spread: list[Any],
    known: "wp.array",
    held: "wp.array",
) -> None:
    """Give the voxels outside of an eroded body, or inside of one that grew, the distances from its sharp edges.

    Distances on the side from which the surface came are those of the field. Beyond edges, each voxel starts from the
    nearest point of the surface as a mesh that keeps edges; tangent planes around that point then bound the body.
    Nothing changes if the level set does not hold distances.

    Args:
        leaves: Leaves of the level set whose surface moves, relative to the isovalue.
        beside: Neighbors of its rows before any was added, because only those have values.
        field: Width of its band, isovalue and voxel size [world].
        half_width: Half width of the new band [voxels].
        spread: Nearest feature of each voxel, and the features.
        known, held: Distances [world], and bit masks of the voxels that have one; both are changed.
    """
    import warp as wp

    from geokit.mesh.model.device_mesh import mesh_on_device
    from geokit.mesh.surfaces.surface import Surface
    from geokit.volume.isosurface.surface_nets import surface_nets
    from geokit.volume.level_set import sharp_edges_kernels as kernels

    device, planes = leaves.device, len(held)
    source = kernels.Field()
    source.volume = leaves.handle
    background, isovalue, voxel_size = field
    source.background, source.isovalue = wp.float64(background), wp.float64(isovalue)
    source.scale = wp.float64(voxel_size if isovalue < 0.0 else -voxel_size)
    near, sound = (wp.empty(planes, dtype=wp.int32, device=device) for _ in range(2))
    inputs = [leaves.values, leaves.active, beside, source]
    launcher.launch(kernels.sound_kernel, planes, inputs, [near, sound], device, grain=GRAIN)
    if prefix_sum(sound)[1] < LEAST_SOUND * prefix_sum(near)[1]:
        return
    beyond = wp.empty(planes, dtype=wp.uint64, device=device)
    counts = wp.empty(planes, dtype=wp.int32, device=device)
    inputs = [leaves.values, leaves.active, leaves.on_device, beside, *spread, source, wp.float64(half_width)]
    launcher.launch(kernels.beyond_edges_kernel, planes, inputs, [known, held, beyond, counts], device, grain=GRAIN)
    ends, count = prefix_sum(counts)
    if not count:
        return
    vertices, faces = surface_nets(leaves.volume, field[1], device, turned=False, sharp=True, transform=np.eye(4))
    if not len(faces):
        return
    points = wp.empty(count, dtype=wp.vec3d, device=device)
    launcher.launch(kernels.list_kernel, planes, [leaves.on_device, beyond, ends], [points], device, grain=GRAIN)
    feet = Surface(mesh_on_device(vertices, faces, ""), device=device).closest_point(points).points
    cells, cell_of = np.unique(np.floor(feet.numpy()).astype(np.int32), axis=0, return_inverse=True)
    rows = wp.array(cells, dtype=wp.vec3i, device=device)
    bounds = wp.empty((len(cells), int(kernels.MOST_PLANES)), dtype=wp.vec4d, device=device)
    bound_counts = wp.empty(len(cells), dtype=wp.int32, device=device)
    launcher.launch(kernels.planes_kernel, len(cells), [rows, source], [bounds, bound_counts], device, grain=16)
    distance = wp.empty(count, dtype=wp.float64, device=device)
    of = wp.array(cell_of.reshape(-1).astype(np.int32), dtype=wp.int32, device=device)
    inputs = [points, feet, of, rows, bounds, bound_counts, source]
    launcher.launch(kernels.project_kernel, count, inputs, [distance], device, grain=GRAIN)
    inputs = [leaves.on_device, *spread, source, beyond, ends, distance]
    launcher.launch(kernels.hold_kernel, planes, inputs, [known, held], device, grain=GRAIN)
