"""Surface nets of a sparse volume, on the CPU or a GPU."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit import _launch
from geokit._download import download
from geokit._pinned import host_flags
from geokit._scratch import Scratch, ScratchArray
from geokit.volume._isosurface_cells import CrossedCells, crossed_cells
from geokit.volume._isosurface_launch import PLANES, launch_planes, offsets_of, require_memory, used_only
from geokit.volume._marching_cubes_cases import loop_table, sum_table
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

    from geokit._host_array import HostArray

__all__ = ["surface_nets"]

# Flags of the count: some cells may have to be joined, some vertices may be unused.
HAS_PROBLEM, HAS_DEAD = 0, 1


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
    table, sums = _tables(device.alias)
    flips, records, vertices, quads, flags = _count(found, table, planes, isovalue)
    (base, first_quad), (vertex_count, quad_count) = offsets_of(vertices, quads)
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
    points, corners = (array.reshape(-1, 3) for array in download(vertex, faces))
    return used_only(points, corners) if flags.numpy()[HAS_DEAD] else (points, corners)


@functools.lru_cache(maxsize=16)
def _tables(device: str) -> tuple["wp.array", "wp.array"]:
    """The loops of all cases, and what their edges add up to, on a device."""
    import warp as wp

    loops, sums = (wp.array(table, dtype=wp.uint32, device=device) for table in (loop_table(), sum_table()))
    return loops, sums


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
) -> tuple[ScratchArray, ScratchArray, ScratchArray, ScratchArray, HostArray]:
    """Joined cells, records, and the numbers of vertices and quads of each plane; flags of what there is."""
    import warp as wp

    from geokit.volume import _surface_nets_cases_kernels as kernels

    device = found.device
    (flips,) = Scratch(device, ((planes,), wp.uint64), zeroed=True).arrays
    shapes = [((planes,), wp.uint64), ((kernels.RECORD * planes,), wp.uint64), *[((planes,), wp.int32)] * 2]
    problems, records, vertices, quads = Scratch(device, *shapes).arrays
    flags = host_flags(2, device)
    outputs = [records, problems, vertices, quads, flags]
    launch_planes(kernels.count_kernel, planes, [found.cells, table, flips], outputs, device)
    if _asks_for_problems(device) or flags.numpy()[HAS_PROBLEM]:
        none, (flips,) = flips, Scratch(device, ((planes,), wp.uint64)).arrays
        inputs = [found.cells, table, none, problems, wp.float64(isovalue)]
        launch_planes(kernels.flips_kernel, planes, inputs, [flips], device)
        inputs = [found.cells, table, flips, problems]
        launch_planes(kernels.count_joined_kernel, planes, inputs, [records, vertices], device)
    return flips, records, vertices, quads, flags


def _asks_for_problems(device: "wp.Device") -> bool:
    """Whether to look for cells to be joined takes less than to wait for the flag that says that there are some."""
    return bool(device.is_cuda)
