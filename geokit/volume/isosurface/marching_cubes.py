"""Marching cubes of a sparse volume, on the CPU or a GPU."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from geokit.core.memory.device_arena import Scratch
from geokit.core.memory.pinned import host_flags
from geokit.volume.isosurface.cells import crossed_cells
from geokit.volume.isosurface.launch import PLANES, fill_offsets, launch_planes, require_memory, used_only
from geokit.volume.isosurface.marching_cubes_cases import triangle_table
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    import warp as wp

__all__ = ["marching_cubes"]


def marching_cubes(
    volume: SparseVolume, isovalue: float, device: Any, *, turned: bool
) -> tuple["wp.array", "wp.array"]:
    """Vertices [world], (V,) of vec3d, and triangle corners, (3 F,) of int32, of an isosurface by marching cubes.

    Args:
        volume: A scalar grid.
        isovalue: Value of the surface.
        device: A warp device.
        turned: Faces point towards decreasing values instead of increasing ones, in index space.

    Returns:
        Vertices and triangles in the order of leaves and voxels; on the device.

    Raises:
        DeviceMemoryError: There is not enough memory.

    Source:
        Lorensen and Cline, Marching Cubes (1987). Differs: inside corners at the ends of a face's diagonal are cut off
        separately, on both sides of the face, and no triangle edge is a diagonal of a face, so each edge has two faces.
    """
    import warp as wp

    from geokit.volume.isosurface import marching_cubes_kernels as kernels

    found = crossed_cells(volume, isovalue, device)
    planes = PLANES * found.count
    start, edges = _tables(device.alias)
    shapes = [((3 * planes,), wp.uint64), *[((planes,), wp.int32)] * 4]
    records, vertices, triangles, base, first_triangle = Scratch(device, *shapes).arrays
    flag = host_flags(1, device)
    outputs = [records, vertices, triangles, flag]
    launch_planes(kernels.count_kernel, planes, [found.cells, start, edges], outputs, device)
    vertex_count, triangle_count = fill_offsets([vertices, triangles], [base, first_triangle])
    has_dead = flag.numpy()[0]  # read before more launches are queued
    require_memory(24 * vertex_count + 12 * triangle_count, device)
    transform = volume.info.transform
    linear, offset = wp.mat33d(*transform[:3, :3].ravel().tolist()), wp.vec3d(*transform[:3, 3].tolist())
    vertex = wp.empty(vertex_count, dtype=wp.vec3d, device=device)
    inputs = [found.cells, records, base, wp.float64(isovalue), linear, offset]
    launch_planes(kernels.vertices_kernel, planes, inputs, [vertex], device)
    faces = wp.empty(3 * triangle_count, dtype=wp.int32, device=device)
    inputs = [found.cells, start, edges, records, base, first_triangle, int(turned)]
    launch_planes(kernels.triangles_kernel, planes, inputs, [faces], device)
    return used_only(vertex, faces) if has_dead else (vertex, faces)


@functools.lru_cache(maxsize=16)
def _tables(device: str) -> tuple["wp.array", "wp.array"]:
    """Triangle tables of all cases on a device: the first triangle of each case, and the edges of the corners."""
    import warp as wp

    start, edges = (wp.array(table, dtype=wp.int32, device=device) for table in triangle_table())
    return start, edges
