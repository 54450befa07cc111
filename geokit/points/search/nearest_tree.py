"""A tree of boxes over points sorted along a Hilbert curve, for searches of the nearest points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.launches import prepared
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.scan import flagged, prefix_sum

# Points of the sample that sets the first frame. Points outside its box, about one in a thousand, are clamped to it.
SAMPLE_SIZE = 4096
# Number of key bits that the sort considers.
KEY_BITS = 30
# Each round makes the cells of crowded points a thousand times finer. A few rounds suffice in practice; unresolved
# cells cost time, but never lose neighbors.
MAX_ROUNDS = 24
# Blocks and boxes that are worth a slice.
BLOCK_GRAIN = 64


def build_tree(points: "wp.array", groups: NDArray[np.int64] | None = None) -> Any:
    """Build the tree over vec3d points.

    Args:
        points: vec3d positions (N,) [world], finite; copied.
        groups: Offsets (G + 1,) of groups of points that no leaf may mix.
    Returns:
        A NearestTree. Memory: 32 bytes a point; during construction up to 16 more, or 64 more if many points share a
        cell of the curve.
    """
    from geokit.points.search import nearest_tree_kernels as kernels

    device: Any = points.device
    count = len(points)
    tree: Any = kernels.NearestTree()
    tree.count = count
    if count == 0:
        tree.positions = wp.empty(0, dtype=wp.float64, device=device)
        return tree
    if groups is None:
        tree.frame = frame_of(points)
        keys, order = curve_order(points, tree.frame, device)
        head = wp.empty(count, dtype=wp.int32, device=device)
        launcher.launch(kernels.head_kernel, count, [keys], [head], device)
        _refine(points, order, head, device)
        tree.positions, tree.index = blocks_in_order(points, order, device)
    else:
        order = group_order(points, groups, MAX_ROUNDS)
        tree.positions, tree.index = blocks_in_order(points, order, device, group_spans(groups)[0])
    _add_boxes(tree, device)
    return tree


def group_order(points: "wp.array", groups: NDArray[np.int64], rounds: int = 1) -> "wp.array":
    """The points in the order of their groups, and along a curve through each that is longer than a leaf."""
    device: Any = points.device
    heads = np.zeros(len(points), dtype=np.int32)
    heads[groups[:-1][np.diff(groups) > 0]] = 1
    order = wp.array(np.arange(len(points)), dtype=wp.int32, device=device)
    _refine(points, order, wp.array(heads, dtype=wp.int32, device=device), device, rounds)
    return order


def group_spans(groups: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Blocks of one group each: first row and end of the group (B, 2), group (B,), and the first block of each group.

    The last is (G + 1,): offsets among the blocks.
    """
    from geokit.points.search import nearest_tree_kernels as kernels

    blocks = -(-np.diff(groups) // int(kernels.LEAF))
    first = np.concatenate([[0], np.cumsum(blocks)])
    group = np.repeat(np.arange(len(blocks)), blocks)
    begin = groups[group] + (np.arange(first[-1]) - first[group]) * int(kernels.LEAF)
    return np.stack([begin, groups[group + 1]], axis=1).astype(np.int32), group.astype(np.int32), first.astype(np.int32)


def frame_of(points: "wp.array") -> Any:
    """Center and inverse edge of a cube around almost all of the points, as a vec4d."""
    from geokit.points.search import nearest_tree_kernels as kernels

    taken = min(len(points), SAMPLE_SIZE)
    sample = wp.empty(taken, dtype=wp.vec3d, device=points.device)
    launcher.launch(kernels.sample_kernel, taken, [points, taken], [sample], points.device)
    rows = sample.numpy()
    lower, upper = 0.5 * rows.min(axis=0), 0.5 * rows.max(axis=0)
    # Halved first: the whole extent may overflow.
    extent, largest = float((upper - lower).max()), float(kernels.MAX_INVERSE)
    inverse = 0.5 / extent if extent * largest > 0.5 else largest
    return wp.vec4d(*(lower + upper).tolist(), inverse)


def curve_order(points: "wp.array", frame: Any, device: Any) -> tuple["wp.array", "wp.array"]:
    """Keys along the curve in ascending order and the indices of their points, in the first half of each array."""
    from geokit.points.search import nearest_tree_kernels as kernels

    count = len(points)
    prepared.refuse()
    # radix_sort_pairs uses the second half of both arrays as scratch space.
    keys = wp.empty(2 * count, dtype=wp.int32, device=device)
    order = wp.empty(2 * count, dtype=wp.int32, device=device)
    launcher.launch(kernels.key_kernel, count, [points, frame], [keys, order], device)
    sort_pairs(keys, order, count, end_bit=KEY_BITS)
    return keys, order


def blocks_in_order(
    points: "wp.array", order: "wp.array", device: Any, spans: Any = None
) -> tuple["wp.array", "wp.array"]:
    """Coordinates in blocks of one leaf each, and the indices of the points; ``spans`` are those of groups."""
    from geokit.points.search import nearest_tree_kernels as kernels

    leaf = int(kernels.LEAF)
    blocks = -(-len(points) // leaf) if spans is None else len(spans)
    positions = wp.empty(blocks * 3 * leaf, dtype=wp.float64, device=device)
    index = wp.empty(blocks * leaf, dtype=wp.int32, device=device)
    of_groups = wp.array([] if spans is None else spans, dtype=wp.vec2i, device=device)
    given = [points, order, of_groups]
    launcher.launch(kernels.block_kernel, len(index), given, [positions, index], device)
    return positions, index


def _refine(points: "wp.array", order: "wp.array", head: "wp.array", device: Any, rounds: int = MAX_ROUNDS) -> None:
    """Sort the points of crowded cells along finer curves, cell by cell, until no cell is crowded.

    A cell is a run of points in ``order``; ``head`` is 1 at the beginning of each, else 0.

    A cell with more points than a leaf would distribute them over leaves at random: one far point could leave all other
    points in one cell.
    """
    from geokit.points.search import nearest_tree_kernels as kernels

    count = len(points)
    run_count = 0
    for _ in range(rounds):
        runs_before = run_count
        run, run_count = prefix_sum(head)
        # Equal points stay together: the first round that separates nothing is the last.
        if run_count == runs_before:
            return
        start = wp.empty(run_count + 1, dtype=wp.int32, device=device)
        launcher.launch(kernels.run_start_kernel, count, [head, run], [start], device)
        crowded = wp.empty(count, dtype=wp.int32, device=device)
        launcher.launch(kernels.crowded_kernel, count, [run, start], [crowded], device)
        member = flagged(crowded)
        if not len(member):
            return
        frame = wp.empty(run_count, dtype=wp.vec4d, device=device)
        launcher.launch(kernels.frame_kernel, run_count, [points, order, start], [frame], device)
        _sort_members(points, order, member, run, frame, head)


def _add_boxes(tree: Any, device: Any) -> None:
    """Build the levels of boxes above the leaves, from the lowest up."""
    from geokit.points.search import nearest_tree_kernels as kernels

    count, width, leaf = len(tree.index), int(kernels.WIDTH), int(kernels.LEAF)
    leaf_count = count // leaf
    sizes = [leaf_count]
    while len(sizes) == 1 or sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // width))
    firsts = np.concatenate([[0, 0], np.cumsum(sizes[1:])])[: len(sizes)]
    tree.top = len(sizes) - 1
    tree.level_first = wp.array(firsts, dtype=wp.int32, device=device)
    node_count = sum(sizes[1:])
    tree.boxes = wp.empty(node_count * 6 * width, dtype=wp.float64, device=device)
    tree.least = wp.empty(node_count * width, dtype=wp.int32, device=device)
    boxes = [tree.boxes, tree.least]
    given = [tree.positions, tree.index, count]
    launcher.launch(kernels.leaf_box_kernel, sizes[1] * width, given, boxes, device, grain=BLOCK_GRAIN)
    for level in range(1, tree.top):
        own = [int(firsts[level]), sizes[level], int(firsts[level + 1])]
        launcher.launch(kernels.node_box_kernel, sizes[level + 1] * width, own, boxes, device, grain=BLOCK_GRAIN)


def _sort_members(
    points: "wp.array", order: "wp.array", member: "wp.array", run: "wp.array", frame: "wp.array", head: "wp.array"
) -> None:
    """Sort the members of each run by their keys in the frame of the run, and mark the resulting runs."""
    from geokit.points.search import nearest_tree_kernels as kernels

    device: Any = points.device
    total = len(member)
    key = wp.empty(total, dtype=wp.int32, device=device)
    sorted_key = wp.empty(2 * total, dtype=wp.int32, device=device)
    slot = wp.empty(2 * total, dtype=wp.int32, device=device)
    given = [points, order, member, run, frame]
    launcher.launch(kernels.member_key_kernel, total, given, [key, sorted_key, slot], device)
    sort_pairs(sorted_key, slot, total, end_bit=KEY_BITS)
    # The sort is stable: sorting by key, then by run, orders by run and by key within a run.
    launcher.launch(kernels.member_run_kernel, total, [slot, member, run], [sorted_key], device)
    sort_pairs(sorted_key, slot, total, end_bit=len(frame).bit_length())
    new_order = wp.empty(total, dtype=wp.int32, device=device)
    launcher.launch(kernels.member_order_kernel, total, [slot, member, order, key], [new_order, head], device)
    launcher.launch(kernels.put_back_kernel, total, [new_order, member], [order], device)
