"""Surface nets of a sparse volume, on the CPU or a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit.volume._isosurface_cells import CrossedCells, crossed_cells
from geokit.volume._isosurface_launch import PLANES, launch_planes, offsets_of, require_memory, used_only
from geokit.volume._marching_cubes_cases import loop_table, sum_table
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

__all__ = ["surface_nets"]


def surface_nets(
    volume: SparseVolume, isovalue: float, device: Any, *, turned: bool, sharp: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3) [world] and triangles (F, 3) of an isosurface.

    Args:
        volume: A scalar grid.
        isovalue: Value of the surface.
        device: A warp device.
        turned: Faces that turn to decreasing values instead of increasing ones, in index space.

    Returns:
        Vertices in the order of leaves and voxels, a pair of triangles for each crossed edge.

    Raises:
        DeviceMemoryError: There is not enough memory.

    Source:
        Gibson, Constrained Elastic Surface Nets (1998). Differs: vertices stay at the mean of the crossings, and a cell
        has one for each sheet, so that edges have two faces.
    """
    import warp as wp

    from geokit.volume import _surface_nets_kernels as kernels

    found = crossed_cells(volume, isovalue, device)
    planes = PLANES * found.count
    table = wp.array(loop_table(), dtype=wp.uint32, device=device)
    sums = wp.array(sum_table(), dtype=wp.uint32, device=device)
    flips, records, vertices, quads, has_dead = _count(found, table, planes, isovalue)
    base, vertex_count = offsets_of(vertices)
    first_quad, quad_count = offsets_of(quads)
    require_memory(24 * (vertex_count + quad_count), device)
    shared = [found.cells, table, flips, records, base]
    transform = volume.info.transform
    linear, offset = wp.mat33d(*transform[:3, :3].ravel().tolist()), wp.vec3d(*transform[:3, 3].tolist())
    vertex = wp.empty(vertex_count, dtype=wp.vec3d, device=device)
    if sharp:
        from geokit.volume import _dual_contouring_kernels as sharpening

        inputs = [*shared, *_around(found, isovalue), linear, offset]
        launch_planes(sharpening.sharpen_kernel, planes, inputs, [vertex], device)
    else:
        inputs = [found.cells, table, sums, *shared[2:], wp.float64(isovalue), linear, offset]
        launch_planes(kernels.vertices_kernel, planes, inputs, [vertex], device)
    faces = wp.empty(6 * quad_count, dtype=wp.int32, device=device)
    inputs = [*shared, first_quad, int(turned), vertex]
    launch_planes(kernels.quads_kernel, planes, inputs, [faces], device)
    result = vertex.numpy().reshape(-1, 3), faces.numpy().reshape(-1, 3)
    return used_only(*result) if has_dead else result


def _around(found: CrossedCells, isovalue: float) -> list["wp.array"]:
    """What stands in the 27 places around each crossed block."""
    import warp as wp

    from geokit.volume import _dual_contouring_kernels as kernels

    count, device = kernels.AROUND * found.count, found.device
    leaf = wp.empty(count, dtype=wp.int32, device=device)
    tile = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [found.cells, found.tree, wp.float64(isovalue)]
    _launch.launch(kernels.around_kernel, count, inputs, [leaf, tile], device)
    return [leaf, tile]


def _count(
    found: CrossedCells, table: "wp.array", planes: int, isovalue: float
) -> tuple["wp.array", "wp.array", "wp.array", "wp.array", bool]:
    """Joined cells, records, and the numbers of vertices and quads of each plane; whether vertices may be unused."""
    import warp as wp

    from geokit.volume import _surface_nets_cases_kernels as kernels

    device = found.device
    flips = wp.zeros(planes, dtype=wp.uint64, device=device)
    problems = wp.empty(planes, dtype=wp.uint64, device=device)
    records = wp.empty(kernels.RECORD * planes, dtype=wp.uint64, device=device)
    vertices = wp.empty(planes, dtype=wp.int32, device=device)
    quads = wp.empty(planes, dtype=wp.int32, device=device)
    flags = wp.zeros(2, dtype=wp.int32, device=device)
    outputs = [records, problems, vertices, quads, flags]
    launch_planes(kernels.count_kernel, planes, [found.cells, table, flips], outputs, device)
    has_problem, has_dead = (bool(flag) for flag in flags.numpy())
    if has_problem:
        none, flips = flips, wp.empty(planes, dtype=wp.uint64, device=device)
        inputs = [found.cells, table, none, problems, wp.float64(isovalue)]
        launch_planes(kernels.flips_kernel, planes, inputs, [flips], device)
        inputs = [found.cells, table, flips, problems]
        launch_planes(kernels.count_joined_kernel, planes, inputs, [records, vertices], device)
    return flips, records, vertices, quads, has_dead
