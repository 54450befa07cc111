"""The tree of a warp Mesh laid out for queries on a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit import _launch

if TYPE_CHECKING:
    import warp as wp

__all__ = ["pack_nodes"]


def pack_nodes(mesh: "wp.Mesh") -> tuple["wp.array", "wp.array"]:
    """The inner nodes of the mesh's tree in rows, float32, and the reference of its root, (1,) of int32."""
    import warp as wp

    from geokit.mesh import _packed_nodes_kernels as kernels

    device, handle = mesh.device, wp.uint64(mesh.id)
    root = wp.empty(1, dtype=wp.int32, device=device)
    _launch.launch(kernels.node_count_kernel, 1, [handle], [root], device)
    count = int(root.numpy()[0])
    inner = wp.empty(count, dtype=wp.int32, device=device)
    place = wp.empty(count, dtype=wp.int32, device=device)
    _launch.launch(kernels.mark_inner_kernel, count, [handle], [inner], device)
    wp.utils.array_scan(inner, place, inclusive=True)
    rows = int(place[-1:].numpy()[0])
    nodes = wp.empty(kernels.NODE_FLOATS * rows, dtype=wp.float32, device=device)
    _launch.launch(kernels.pack_nodes_kernel, count, [handle, place], [nodes, root], device)
    return nodes, root
