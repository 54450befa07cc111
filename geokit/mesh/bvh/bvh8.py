"""The tree of CPU queries: eight children per node, eight triangles per leaf, one vector operation for all eight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher

if TYPE_CHECKING:
    import warp as wp

    from geokit.core.frame import Frame

__all__ = ["build_wide_tree", "fill_leaves", "ray_leaves", "refit_wide_tree"]

# References of a subtree that one thread builds. Smaller subtrees balance better; larger ones leave less to the top,
# which a single thread builds.
SMALLEST_SUBTREE = 2048
SUBTREES = 128
# Capacity of the top in nodes; a larger top ends here, and its last subtrees are larger instead.
TOP_CAPACITY = 4096
# 32-bit words of a range that waits to be opened, with its depth.
WAITING_WORDS = 19
# Lower bound of references per node: a lowest node has at least nine, any other one at least seven leaves and a node.
NODE_SHARE = 3
# Triangles side by side in a leaf on a CPU.
WIDTH = 8


def build_wide_tree(vertices: "wp.array", faces: "wp.array", frame: Frame) -> dict[str, Any]:
    """Boxes, children and slots of the tree with eight children per node over triangles, on the CPU.

    Args:
        vertices: Vertex positions [world], (V,) of vec3d.
        faces: Vertex indices, (3 F,) of int32, F at least 1.
        frame: The local frame.
    Returns:
        ``boxes``, ``children`` and ``slot_triangle``, as described in :class:`SurfaceTree`.
    Source:
        Wald, "On fast construction of SAH-based bounding volume hierarchies" (2007), for the bins; Wald, Benthin,
        Boulos, "Getting rid of packets" (2008), for wide nodes by opening the child of largest area.
    """
    import warp as wp

    from geokit.mesh.bvh import bvh8_build_cpu_kernels as kernels
    from geokit.mesh.bvh.tree_memory import tree_array

    device = wp.get_device("cpu")
    count = len(faces) // 3

    def empty(size: int, dtype: Any = wp.int32) -> "wp.array":
        return wp.empty(size, dtype=dtype, device=device)

    references = empty(kernels.REFERENCE * count, wp.float32)
    placed = [wp.vec3d(*map(float, frame.origin)), wp.float64(frame.scale)]
    launcher.launch(kernels.references_kernel, count, [vertices, faces, *placed], [references], device)

    limit = max(SMALLEST_SUBTREE, count // SUBTREES)
    capacity = min(TOP_CAPACITY, count // limit + 8)
    top = empty(48 * capacity, wp.float32), empty(8 * capacity)
    subtree, top_size = empty(3 * 8 * capacity), empty(2)
    scratch = empty(WAITING_WORDS * capacity)
    launcher.launch(
        kernels.top_kernel, 1, [references, count, limit, capacity, scratch], [*top, subtree, top_size], device
    )
    top_count, subtrees = (int(n) for n in top_size.numpy())
    ranges = subtree.numpy()[: 3 * subtrees].reshape(-1, 3)

    # Oversized arrays are free: memory pages that are never written take no space.
    room = (ranges[:, 1] - ranges[:, 0]) // NODE_SHARE + 2
    node_base = _offsets(room)
    parts = empty(48 * int(node_base[-1]), wp.float32), empty(8 * int(node_base[-1]))
    leaf = empty(count), empty(count)
    size = empty(2 * subtrees)
    base = wp.array(node_base[:-1], dtype=wp.int32, device=device)
    launcher.launch(
        kernels.subtree_kernel, subtrees, [references, subtree, base], [*parts, *leaf, size], device, grain=1
    )

    sizes = size.numpy().reshape(-1, 2)
    node_offset, leaf_offset = top_count + _offsets(sizes[:, 0]), _offsets(sizes[:, 1])
    node_count, leaf_count = int(node_offset[-1]), int(leaf_offset[-1])
    boxes = tree_array(48 * node_count, wp.float32, device)
    children = tree_array(8 * node_count, wp.int32, device)
    slot_triangle = tree_array(8 * leaf_count, wp.int32, device)
    offsets = [wp.array(a[:-1], dtype=wp.int32, device=device) for a in (node_offset, leaf_offset)]
    launcher.launch(
        kernels.join_kernel,
        subtrees,
        [references, subtree, base, size, *offsets, *parts, *leaf],
        [boxes, children, slot_triangle],
        device,
        grain=1,
    )
    launcher.launch(kernels.link_top_kernel, top_count, [size, *offsets, *top], [boxes, children], device)
    return {"boxes": boxes, "children": children, "slot_triangle": slot_triangle}


def fill_leaves(slot_triangle: "wp.array", corners: "wp.array", frame: Frame, *, wide: bool) -> "wp.array":
    """The triangles of the slots in float32 frames, from their world ``corners``; in blocks of eight if ``wide``."""
    import warp as wp

    from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import PLANE_ROWS, SLOT_WORDS, leaf_planes_kernel
    from geokit.mesh.bvh.tree_memory import tree_array

    device = slot_triangle.device
    lanes, rows = (WIDTH, PLANE_ROWS) if wide else (1, SLOT_WORDS)
    leaves = tree_array(rows * len(slot_triangle), wp.float32, device)
    placed = [wp.vec3d(*map(float, frame.origin)), wp.float64(frame.scale)]
    inputs = [slot_triangle, corners, *placed, lanes, rows]
    launcher.launch(leaf_planes_kernel, len(slot_triangle), inputs, [leaves], device)
    return leaves


def ray_leaves(tree: Any) -> "wp.array":
    """The packed ray leaves of a tree on the CPU."""
    import warp as wp

    from geokit.mesh.bvh.bvh8_leaves_cpu_kernels import LEAF_WORDS, ray_leaves_kernel
    from geokit.mesh.bvh.tree_memory import tree_array

    device = tree.slot_triangle.device
    blocks = len(tree.slot_triangle) // WIDTH
    leaves = tree_array(LEAF_WORDS * blocks, wp.float32, device)
    inputs = [tree.slot_triangle, tree.corners, tree.leaves, tree.origin, tree.scale]
    launcher.launch(ray_leaves_kernel, blocks, inputs, [leaves], device)
    return leaves


def refit_wide_tree(tree: Any, frame: Frame) -> None:
    """Recompute the boxes of the tree's nodes after its ``corners`` have moved."""
    import warp as wp

    from geokit.mesh.bvh.bvh8_build_cpu_kernels import block_boxes_kernel, refit_kernel

    device = tree.corners.device
    blocks = len(tree.slot_triangle) // WIDTH
    boxes = wp.empty(6 * blocks, dtype=wp.float32, device=device)
    placed = [wp.vec3d(*map(float, frame.origin)), wp.float64(frame.scale)]
    launcher.launch(block_boxes_kernel, blocks, [tree.slot_triangle, tree.corners, *placed], [boxes], device)
    count = len(tree.children) // WIDTH
    launcher.launch(refit_kernel, 1, [count, tree.children, boxes], [tree.boxes], device)


def _offsets(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
