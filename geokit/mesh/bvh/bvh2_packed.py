"""The tree of a warp Mesh, packed for queries on a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geokit.core import launcher
from geokit.core.memory.unchecked import allocating
from geokit.core.scan import prefix_sum

if TYPE_CHECKING:
    import warp as wp

__all__ = ["pack_nodes", "wide_slots"]

# Triangles that any hits test before the tree, at most, and the share of the area that they need to hold together.
MOST_WIDE = 32
WIDE_SHARE = 0.15
# Only triangles with this share of the area count.
LEAST_SHARE = 1.0 / 256.0


def pack_nodes(mesh: "wp.Mesh", most: int, padding: float, leaves: "wp.array") -> tuple["wp.array", "wp.array"]:
    """The tree with its small subtrees turned into leaves.

    Args:
        mesh: The mesh.
        most: Most triangles in a leaf, at most 7.
        padding: Added to warp's boxes on each side [local].
        leaves: The rows of the triangles. If a leaf of warp's holds more than ``most`` triangles, its
            count is stored in its first row.
    Returns:
        The nodes as rows of float32, and the reference of the root, (1,) of int32.
    """
    import warp as wp

    from geokit.mesh.bvh import bvh2_packed_cuda_kernels as kernels

    device, handle = mesh.device, wp.uint64(mesh.id)
    root = wp.empty(1, dtype=wp.int32, device=device)
    launcher.launch(kernels.node_count_kernel, 1, [handle], [root], device)
    count = int(root.numpy()[0])
    kept = wp.empty(count, dtype=wp.int32, device=device)
    place = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.mark_kept_kernel, count, [handle, most], [kept], device)
    wp.utils.array_scan(kept, place, inclusive=True)
    rows = int(place[-1:].numpy()[0])
    nodes = wp.empty(kernels.NODE_FLOATS * rows, dtype=wp.float32, device=device)
    launcher.launch(
        kernels.pack_nodes_kernel,
        count,
        [handle, most, wp.float32(padding), kept, place],
        [leaves, nodes, root],
        device,
    )
    return nodes, root


def wide_slots(corners: "wp.array") -> "wp.array":
    """Slots of the few triangles that hold much of the area, the widest first, int32; none where there are no such.

    Args:
        corners: World corners of the triangle in each slot, three per slot.
    """
    import warp as wp

    from geokit.mesh.bvh import bvh2_any_hit_cuda_kernels as kernels

    device, slots = corners.device, len(corners) // 3
    area = wp.empty(slots, dtype=wp.float64, device=device)
    launcher.launch(kernels.area_kernel, slots, [corners], [area], device)
    with allocating(device, slots):
        whole = float(wp.utils.array_sum(area))
    is_wide = wp.empty(slots, dtype=wp.int32, device=device)
    launcher.launch(kernels.mark_wide_kernel, slots, [area, wp.float64(LEAST_SHARE * whole)], [is_wide], device)
    place, count = prefix_sum(is_wide)
    if not (whole > 0.0 and count > 0):
        return wp.empty(0, dtype=wp.int32, device=device)
    found = [wp.empty(count, dtype=kind, device=device) for kind in (wp.int32, wp.float64)]
    launcher.launch(kernels.list_wide_kernel, slots, [area, is_wide, place], found, device)
    some, areas = (array.numpy() for array in found)
    widest = np.argsort(-areas, kind="stable")[:MOST_WIDE]
    chosen = some[widest] if areas[widest].sum() >= WIDE_SHARE * whole else some[:0]
    return wp.array(chosen, dtype=wp.int32, device=device)
