"""The tree that queries on a GPU walk."""

from __future__ import annotations

from typing import Any

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.frame import Frame
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.scan import prefix_sum

# Most levels of a tree; the stacks of searches hold 64 nodes.
MOST_LEVELS = 58
# Triangles in a leaf: one costs rays up to a fifth, four up to a tenth; closest points of smooth bodies gain a tenth
# from six, those among boxes, leaves and loose triangles lose as much (measured on an H200).
MOST_IN_LEAF = 3


def build_binary_tree(vertices: "wp.array", faces: "wp.array", frame: Frame) -> Any:
    """A :class:`SurfaceTree` as queries on a GPU walk it.

    Args:
        vertices, faces: World coordinates (V,) of vec3d, and three indices for each triangle.
        frame: The local frame.
    """
    from geokit.mesh.bvh import bvh2_cuda_kernels as kernels
    from geokit.mesh.bvh.leaf_planes_kernels import SLOT_WORDS, leaf_planes_kernel
    from geokit.mesh.bvh.ray_walk_kernels import RAY_PADDING
    from geokit.mesh.bvh.tree_kernels import SurfaceTree, gather_corners_kernel

    device, count, tree = vertices.device, len(faces) // 3, SurfaceTree()
    tree.origin, tree.scale = placed = wp.vec3d(*map(float, frame.origin)), wp.float64(frame.scale)
    order, boxes, links, parent = _merged(vertices, faces, placed)
    place, kept = (wp.empty(count - 1, dtype=kind, device=device) for kind in (wp.vec2i, wp.int32))
    tree.slot_triangle = wp.empty(count, dtype=wp.int32, device=device)
    outputs = [place, kept, tree.slot_triangle]
    launcher.launch(kernels.place_kernel, 2 * count, [links, parent, order, MOST_IN_LEAF], outputs, device)
    del order, parent
    row, rows = prefix_sum(kept)
    tree.boxes = wp.empty(kernels.NODE_FLOATS * rows, dtype=wp.float32, device=device)
    inputs = [boxes, links, place, row, MOST_IN_LEAF, wp.float32(RAY_PADDING)]
    launcher.launch(kernels.nodes_kernel, count - 1, inputs, [tree.boxes, tree.boxes.view(wp.int32)], device)
    tree.children = wp.array([0 if rows else -count], dtype=wp.int32, device=device)
    del boxes, links, place, kept, row, inputs
    tree.corners = wp.empty(3 * count, dtype=wp.vec3d, device=device)
    launcher.launch(gather_corners_kernel, count, [tree.slot_triangle, vertices, faces], [tree.corners], device)
    tree.leaves = wp.empty(SLOT_WORDS * count, dtype=wp.float32, device=device)
    launcher.launch(leaf_planes_kernel, count, [tree.slot_triangle, tree.corners, *placed], [tree.leaves], device)
    return tree


def _merged(vertices: "wp.array", faces: "wp.array", placed: tuple[Any, Any]) -> tuple[Any, ...]:
    """The triangles merged into a binary tree of boxes with small areas.

    No branch has more than MOST_LEVELS: where clusters have so many that halving their number would no longer keep
    that, neighbors merge.

    Returns:
        The triangles in Morton order, and the boxes, links and parents of ``merge_kernel``; the last node is the root.
    Source:
        Meister, Bittner, "Parallel locally-ordered clustering for bounding volume hierarchy construction" (2018).
        Differs: blocks of threads merge clusters in several rounds, each its own.
    """
    from geokit.mesh.bvh import bvh2_cuda_kernels as kernels

    device, count = vertices.device, len(faces) // 3

    def empty(size: int, dtype: Any) -> Any:
        return wp.empty(size, dtype=dtype, device=device)

    # radix_sort_pairs uses the second half of both arrays as scratch space.
    keys, order = empty(2 * count, wp.int64), empty(2 * count, wp.int32)
    launcher.launch(kernels.key_kernel, count, [vertices, faces, *placed], [keys, order], device)
    sort_pairs(keys, order, count, end_bit=3 * kernels.AXIS_BITS)
    del keys
    clusters, merged = empty(count, kernels.Cluster), empty(count, kernels.Cluster)
    launcher.launch(kernels.clusters_kernel, count, [vertices, faces, order, *placed], [clusters], device)
    boxes, links, parent = empty(4 * (count - 1), wp.vec3), empty(count - 1, wp.vec4i), empty(2 * count, wp.int32)
    made, left = wp.zeros(1, dtype=wp.int32, device=device), count
    offsets = wp.array([0, count], dtype=wp.int32, device=device)
    while left > 1:
        chunks = -(-left // kernels.CHUNK)
        inputs = [clusters, offsets, MOST_LEVELS - left.bit_length(), made, boxes, links, parent]
        counts = empty(chunks + 1, wp.int32)
        threads = chunks * (1 if device.is_cpu else kernels.THREADS)
        launcher.launch(kernels.merge_kernel, threads, inputs, [merged, counts], device, grain=1)
        if chunks == 1:
            break
        offsets = empty(chunks + 1, wp.int32)
        wp.utils.array_scan(counts, offsets, inclusive=False)
        left = int(offsets[-1:].numpy()[0])
        clusters, merged = merged, clusters
    return order, boxes, links, parent
