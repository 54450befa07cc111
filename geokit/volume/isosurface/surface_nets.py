"""Isosurfaces of a sparse volume by surface nets and by marching cubes, on the CPU or a GPU."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.device_arena import Scratch, ScratchArray
from geokit.core.memory.pinned import host_flags
from geokit.volume.isosurface.cells import CrossedCells, crossed_cells
from geokit.volume.isosurface.launch import PLANES, fill_offsets, launch_planes, require_memory, used_only
from geokit.volume.isosurface.marching_cubes_cases import loop_table, sum_table, triangle_table
from geokit.volume.model.sparse_volume import SparseVolume

if TYPE_CHECKING:
    from geokit.core.memory.host_array import HostArray

# Flags of the count: some cells may need a joined face, some vertices may be unused.
HAS_PROBLEM, HAS_DEAD = 0, 1


def surface_nets(
    volume: SparseVolume,
    isovalue: float,
    device: Any,
    *,
    turned: bool,
    sharp: bool = False,
    transform: NDArray[np.float64] | None = None,
) -> tuple["wp.array", "wp.array"]:
    """Vertices, (V,) of vec3d, and triangle corners, (3 F,) of int32, of an isosurface by surface nets.

    Args:
        volume: A scalar grid.
        isovalue: Value of the surface.
        device: A warp device.
        turned: Faces point towards decreasing values instead of increasing ones, in index space.
        sharp: Vertices move to edges and corners of the field, as in dual contouring.
        transform: From voxels to the space of the vertices, (4, 4); None for that of the volume [world].

    Returns:
        Vertices in the order of leaves and voxels, and two triangles for each crossed edge; on the device.

    Raises:
        DeviceMemoryError: There is not enough memory.

    Source:
        Gibson, Constrained Elastic Surface Nets (1998). Differs: vertices stay at the mean of the crossings, and a cell
        has a vertex for each sheet, so that each edge has two faces.
    """
    from geokit.volume.isosurface import surface_nets_kernels as kernels

    found = crossed_cells(volume, isovalue, device)
    planes = PLANES * found.count
    nets: Any = kernels.Nets()
    nets.table, nets.sums = _tables(device.alias)
    flips, records, counts, starts, flags = _count(found, nets.table, planes, isovalue)
    base, first_quad = starts
    vertex_count, quad_count = fill_offsets(counts, starts)
    nets.flips, nets.records, nets.base = flips.warp, records.warp, base.warp
    has_dead = flags.numpy()[HAS_DEAD]  # read before more launches are queued
    require_memory(24 * (vertex_count + quad_count), device)
    transform = volume.info.transform if transform is None else transform
    linear, offset = wp.mat33d(*transform[:3, :3].ravel().tolist()), wp.vec3d(*transform[:3, 3].tolist())
    vertex = wp.empty(vertex_count, dtype=wp.vec3d, device=device)
    if sharp:
        from geokit.volume.isosurface import dual_contouring_kernels as sharpening

        inputs = [found.cells, nets, *_around(found, isovalue), linear, offset]
        launch_planes(sharpening.sharpen_kernel, planes, inputs, [vertex], device)
    else:
        inputs = [found.cells, nets, wp.float64(isovalue), linear, offset]
        launch_planes(kernels.vertices_kernel, planes, inputs, [vertex], device)
    faces = wp.empty(6 * quad_count, dtype=wp.int32, device=device)
    inputs = [found.cells, nets, first_quad, int(turned), vertex]
    launch_planes(kernels.quads_kernel, planes, inputs, [faces], device)
    return used_only(vertex, faces) if has_dead else (vertex, faces)


@functools.lru_cache(maxsize=16)
def _tables(device: str) -> tuple["wp.array", "wp.array"]:
    """loop_table and sum_table on a device."""
    loops, sums = (wp.array(table, dtype=wp.uint32, device=device) for table in (loop_table(), sum_table()))
    return loops, sums


def _around(found: CrossedCells, isovalue: float) -> list["wp.array"]:
    """Leaf or tile value in the 27 places around each crossed block."""
    from geokit.volume.isosurface import dual_contouring_kernels as kernels

    count, device = kernels.AROUND * found.count, found.device
    leaf = wp.empty(count, dtype=wp.int32, device=device)
    tile = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [found.cells, found.tree, wp.float64(isovalue)]
    launcher.launch(kernels.around_kernel, count, inputs, [leaf, tile], device)
    return [leaf, tile]


def _count(
    found: CrossedCells, table: "wp.array", planes: int, isovalue: float
) -> tuple[ScratchArray, ScratchArray, list[ScratchArray], list[ScratchArray], HostArray]:
    """Joined cells, records, vertex and quad counts of each plane, arrays for their prefix sums, and flags."""
    from geokit.volume.isosurface import surface_nets_cases_kernels as kernels

    device = found.device
    words = [((size * planes,), wp.uint64) for size in (1, 1, kernels.RECORD)]
    problems, flips, records, *sums = Scratch(device, *words, *[((planes,), wp.int32)] * 4).arrays
    flags = host_flags(2, device)
    outputs = [flips, records, problems, *sums[:2], flags]
    launch_planes(kernels.count_kernel, planes, [found.cells, table], outputs, device)
    if _searches_without_flag(device) or flags.numpy()[HAS_PROBLEM]:
        inputs = [found.cells, table, problems, wp.float64(isovalue)]
        launch_planes(kernels.flips_kernel, planes, inputs, [flips], device)
        inputs = [found.cells, table, flips, problems]
        launch_planes(kernels.count_joined_kernel, planes, inputs, [records, sums[0]], device)
    return flips, records, sums[:2], sums[2:], flags


def _searches_without_flag(device: "wp.Device") -> bool:
    """Whether searching for cells with a joined face is cheaper than waiting for the flag that they exist."""
    return bool(device.is_cuda)


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
    from geokit.volume.isosurface import marching_cubes_kernels as kernels

    found = crossed_cells(volume, isovalue, device)
    planes = PLANES * found.count
    start, edges = _triangle_tables(device.alias)
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
def _triangle_tables(device: str) -> tuple["wp.array", "wp.array"]:
    """Triangle tables of all cases on a device: the first triangle of each case, and the edges of the corners."""
    start, edges = (wp.array(table, dtype=wp.int32, device=device) for table in triangle_table())
    return start, edges
