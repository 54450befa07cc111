"""The tree of a warp Mesh, packed for queries on a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit.core import launcher

if TYPE_CHECKING:
    import warp as wp

__all__ = ["pack_nodes"]


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
