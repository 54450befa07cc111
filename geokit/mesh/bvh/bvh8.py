"""The tree of CPU queries: eight children per node, eight triangles per leaf, one vector operation for all eight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory import host_pool
from geokit.core.memory.host_array import HostArray, row_of

if TYPE_CHECKING:
    from geokit.core.frame import Frame

# References of a subtree that one thread builds. Smaller subtrees balance better; larger ones leave less to the top,
# which a single thread builds.
SMALLEST_SUBTREE = 2048
SUBTREES = 128
# Capacity of the top in nodes; a larger top ends here, and its last subtrees are larger instead.
TOP_CAPACITY = 4096
# Lower bound of references per node: a lowest node has at least nine, any other one at least seven leaves and a node.
NODE_SHARE = 3
# Triangles side by side in a leaf on a CPU.
WIDTH = 8
# Bytes of a cache line; nodes and leaves are three lines long.
LINE = 64


class WideTrees(NamedTuple):
    """Trees with eight children per node, one after another.

    Attributes:
        boxes, children: As described in :class:`SurfaceTree`; children are numbered from their tree's root on.
        slot_triangle: The triangle in each slot, numbered over all trees; -1 for empty slots.
        nodes: The first node of each tree, and their number, (B + 1,).
        slots: The first slot of each tree, and their number, (B + 1,).
    """

    boxes: "wp.array"
    children: "wp.array"
    slot_triangle: "wp.array"
    nodes: NDArray[np.int64]
    slots: NDArray[np.int64]


def build_wide_trees(
    vertices: "wp.array",
    faces: "wp.array",
    begin: NDArray[np.int64],
    origins: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> WideTrees:
    """Boxes, children and slots of the trees with eight children per node over triangles, on the CPU.

    A tree depends on its own triangles only: a mesh among others gets the tree that it gets alone.

    Args:
        vertices: Vertex positions [world], (V,) of vec3d.
        faces: Vertex indices, (3 F,) of int32.
        begin: The first triangle of each tree, which has at least one, and F, (B + 1,).
        origins, scales: Their local frames, (B, 3) and (B,).
    Source:
        Wald, "On fast construction of SAH-based bounding volume hierarchies" (2007), for the bins; Wald, Benthin,
        Boulos, "Getting rid of packets" (2008), for wide nodes by opening the child of largest area.
    """
    from geokit.mesh.bvh import bvh8_build_cpu_kernels as kernels

    device = wp.get_device("cpu")
    count, trees = len(faces) // 3, len(scales)

    def empty(size: int, dtype: Any = wp.int32) -> "wp.array":
        return wp.empty(size, dtype=dtype, device=device)

    references = host_pool.empty_warp(kernels.REFERENCE * count, wp.float32, device)
    sides = empty(count, wp.uint8)
    first = _int32(begin)
    placed = [first, HostArray(origins), HostArray(scales)]
    launcher.launch(kernels.references_kernel, count, [vertices, faces, *placed], [references], device)

    counts = np.diff(begin)
    limit = np.maximum(SMALLEST_SUBTREE, counts // SUBTREES)
    capacity = np.where(counts <= limit, 1, np.minimum(TOP_CAPACITY, counts // limit + 8))
    base = offsets_of(capacity)
    room = int(base[-1])
    top = empty(48 * room, wp.float32), empty(WIDTH * room)
    subtree, top_size = empty(3 * WIDTH * room), empty(2 * trees)
    inputs = [references, sides, first, _int32(base), _int32(limit), empty(kernels.WAITING_WORDS * room)]
    launcher.launch(kernels.top_kernel, trees, inputs, [*top, subtree, top_size], device, grain=1)
    top_counts, subtree_counts = top_size.numpy().reshape(-1, 2).T.astype(np.int64)
    # Subtrees and nodes of tops from here on: those of all trees, without the gaps between them.
    tree, first_subtree = np.repeat(np.arange(trees), subtree_counts), offsets_of(subtree_counts)
    ranges = subtree.numpy().reshape(-1, 3)[_spans(WIDTH * base[:-1], subtree_counts)]
    subtrees, subtree = len(ranges), _int32(ranges.ravel())

    # Oversized arrays are free: memory pages that are never written take no space.
    node_base = offsets_of((ranges[:, 1] - ranges[:, 0]) // NODE_SHARE + 2)
    parts = empty(48 * int(node_base[-1]), wp.float32), empty(8 * int(node_base[-1]))
    leaf = empty(count), empty(count)
    size = empty(2 * subtrees)
    starts = _int32(node_base[:-1])
    launcher.launch(
        kernels.subtree_kernel, subtrees, [references, sides, subtree, starts], [*parts, *leaf, size], device, grain=1
    )

    nodes_before, leaves_before = (offsets_of(column) for column in size.numpy().reshape(-1, 2).T)
    nodes, leaves = offsets_of(top_counts) + nodes_before[first_subtree], leaves_before[first_subtree]
    leaf_place = leaves_before[:-1]
    node_offset = nodes_before[:-1] - nodes_before[first_subtree[tree]] + top_counts[tree]
    boxes = tree_array(48 * int(nodes[-1]), wp.float32, device)
    children = tree_array(8 * int(nodes[-1]), wp.int32, device)
    slot_triangle = tree_array(WIDTH * int(leaves[-1]), wp.int32, device)
    offsets = [_int32(node_offset), _int32(leaf_place - leaves[tree])]
    inputs = [references, subtree, starts, size, *offsets, _int32(node_offset + nodes[tree]), _int32(leaf_place)]
    inputs += [*parts, *leaf]
    launcher.launch(kernels.join_kernel, subtrees, inputs, [boxes, children, slot_triangle], device, grain=1)
    places = [_spans(base[:-1], top_counts), _spans(nodes[:-1], top_counts), np.repeat(first_subtree[:-1], top_counts)]
    inputs = [size, *offsets, *top, *map(_int32, places)]
    launcher.launch(kernels.link_top_kernel, len(places[0]), inputs, [boxes, children], device)
    return WideTrees(boxes, children, slot_triangle, nodes, WIDTH * leaves)


def place_triangles(
    slot_triangle: "wp.array",
    slots: NDArray[np.int64],
    vertices: "wp.array",
    faces: "wp.array",
    origins: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> tuple["wp.array", "wp.array"]:
    """The triangles of trees in slot order: world corners, and leaves as described in :class:`SurfaceTree`.

    Args:
        slot_triangle, slots: As of :class:`WideTrees`.
        vertices, faces, origins, scales: As of :func:`build_wide_trees`.
    """
    from geokit.mesh.bvh.bvh8_build_cpu_kernels import place_blocks_kernel
    from geokit.mesh.bvh.leaf_planes_kernels import PLANE_ROWS

    device, count = slot_triangle.device, len(slot_triangle)
    placed = tree_array(3 * count, wp.vec3d, device), tree_array(PLANE_ROWS * count, wp.float32, device)
    inputs = [_int32(slots), slot_triangle, vertices, faces, HostArray(origins), HostArray(scales)]
    launcher.launch(place_blocks_kernel, count // WIDTH, inputs, placed, device)
    return placed


def ray_leaves(
    slot_triangle: "wp.array",
    slots: NDArray[np.int64],
    placed: tuple["wp.array", "wp.array"],
    origins: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> "wp.array":
    """The packed leaves for rays; the arguments are those and the answer of :func:`place_triangles`."""
    from geokit.mesh.bvh.bvh8_build_cpu_kernels import LEAF_WORDS, ray_leaves_kernel

    device, blocks = slot_triangle.device, len(slot_triangle) // WIDTH
    leaves = tree_array(LEAF_WORDS * blocks, wp.float32, device)
    inputs = [_int32(slots), slot_triangle, *placed, HostArray(origins), HostArray(scales)]
    launcher.launch(ray_leaves_kernel, blocks, inputs, [leaves], device)
    return leaves


def refit_wide_tree(tree: Any, frame: Frame) -> None:
    """Recompute the boxes of the tree's nodes after its ``corners`` have moved."""
    from geokit.mesh.bvh.bvh8_build_cpu_kernels import block_boxes_kernel, refit_kernel

    device = tree.corners.device
    blocks = len(tree.slot_triangle) // WIDTH
    boxes = wp.empty(6 * blocks, dtype=wp.float32, device=device)
    placed = [wp.vec3d(*map(float, frame.origin)), wp.float64(frame.scale)]
    launcher.launch(block_boxes_kernel, blocks, [tree.slot_triangle, tree.corners, *placed], [boxes], device)
    count = len(tree.children) // WIDTH
    launcher.launch(refit_kernel, 1, [count, tree.children, boxes], [tree.boxes], device)


def offsets_of(counts: ArrayLike) -> NDArray[np.int64]:
    """Where each part begins, and their end, by the sizes of the parts."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _spans(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers from each start on, as many as its count."""
    return np.arange(counts.sum()) + np.repeat(starts - offsets_of(counts)[:-1], counts)


def _int32(values: NDArray[Any]) -> HostArray:
    return HostArray(np.ascontiguousarray(values, np.int32))


def tree_array(size: int, dtype: Any, device: "wp.Device") -> "wp.array":
    """``warp.empty`` for trees; on a CPU the array is aligned to a cache line.

    Queries read a tree at random places: with pages of 4 KiB the address translation takes as long as the data. NumPy
    asks Linux for huge pages from 4 MiB on, where the system provides them on request; warp and malloc do not. The host
    pool (core/memory/host_pool.py) is not used, because trees live long.
    """
    if device.is_cuda:
        return wp.empty(size, dtype=dtype, device=device)
    length = size * wp.types.type_size_in_bytes(dtype)
    memory = np.empty(length + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    row = row_of(dtype)
    return HostArray(memory[start : start + length].view(row.dtype).reshape(size, *row.shape[1:])).warp
