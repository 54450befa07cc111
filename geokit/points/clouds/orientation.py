"""Consistent orientation of normals by votes of neighbors."""

from __future__ import annotations

from typing import NamedTuple

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.memory.unchecked import sort_pairs
from geokit.core.scan import prefix_sum
from geokit.errors import InputError

# Each edge is listed twice, and the lists are counted in int32.
MAX_EDGES = 1 << 30
# The number of an edge has 32 bits beside the 32 bits of its weight.
NUMBER_BITS = 32
# Rounds along single edges. They leave clusters of some twenty points, between which enough edges run to vote; a vote
# from the start is no better, and sorts three times as many pairs.
TREE_ROUNDS = 3
# Bits of a whole number without its sign and one to spare.
SUM_BITS = 62


class _Edges(NamedTuple):
    """The edges of each point, the least first: ``edge[begin[i]:end[i]]``."""

    edge: "wp.array"
    begin: "wp.array"
    end: "wp.array"


def propagate_signs(
    points: "wp.array",
    normal: "wp.array",
    order: "wp.array",
    distance: "wp.array",
    neighbor: "wp.array",
    device: "wp.Device",
) -> None:
    """Orient normals in place so that neighbors agree, and each component outwards.

    Args:
        points: vec3d (N,), in an order that puts neighbors close in memory.
        normal: vec3d (N,), unit length or zeros; zeros have no edges. In the caller's order.
        order: Places in the caller's order of the points, int32 (N,) or longer.
        distance: Distances of the neighbors, in the caller's order, ascending, float64 (N, k).
        neighbor: Neighbors of each point, as positions in ``points``, int32 (N, k), -1 for none.
        device: Device of the arrays.
    Raises:
        InputError: There are more than 2^30 edges, or 2^32 with k rounded up to a power of two.
    Source:
        Boruvka's algorithm: each round joins every cluster to another one. In the first rounds by the least edge
        between them, with weights in float32; then by the clearest vote of all edges between them. Ties are broken by
        position, so that the result is the same on every device and for any number of threads.
    """
    from geokit.points.clouds import orientation_kernels as kernels

    count = len(points)
    # Number of bits of a column of the table.
    bits = (neighbor.shape[1] - 1).bit_length()
    if neighbor.size > MAX_EDGES or count > 1 << (NUMBER_BITS - bits):
        raise InputError(
            f"k: {count} points with {neighbor.shape[1]} neighbors each are too many edges to number; "
            "give a smaller k, or another orientation"
        )

    def filled(value: int) -> "wp.array":
        return wp.full(count, value, dtype=wp.int64, device=device)

    none = int(kernels.NONE)
    placed = wp.empty(count, dtype=wp.vec3d, device=device)
    reach = wp.zeros(count, dtype=wp.float64, device=device)
    link, best, hook = filled(0), filled(none), filled(-1)
    launcher.launch(kernels.start_kernel, count, [order, normal, distance], [placed, reach, link], device)
    rows = _edges(points, placed, reach, neighbor, bits, device)
    for _ in range(TREE_ROUNDS):
        given = [neighbor, bits, rows.edge, rows.end, link]
        launcher.launch(kernels.best_edge_kernel, count, given, [rows.begin, best], device)
        launcher.launch(kernels.hook_kernel, count, [placed, neighbor, bits, link, best], [hook], device)
        launcher.launch(kernels.apply_kernel, count, [hook], [link, best], device)
        launcher.launch(kernels.flatten_kernel, count, [], [link], device)
    _vote(placed, neighbor, bits, rows, link, best, hook, device)
    width = wp.zeros(count, dtype=wp.float64, device=device)
    extent = [filled(none), filled(none), filled(none)]
    given = [points, placed, reach, neighbor, link]
    launcher.launch(kernels.extent_kernel, count, given, [width, *extent], device)
    volume = wp.zeros((count, 2 * int(kernels.CAPS)), dtype=wp.int64, device=device)
    scale = wp.float64(2.0 ** (SUM_BITS - count.bit_length()))
    runs = -(-count // int(kernels.VOLUME_RUN))
    launcher.launch(kernels.volume_kernel, runs, [points, placed, width, link, *extent, scale], [volume], device)
    launcher.launch(kernels.turn_kernel, count, [order, link, volume], [normal], device)


def _edges(
    points: "wp.array", normal: "wp.array", reach: "wp.array", neighbor: "wp.array", bits: int, device: "wp.Device"
) -> _Edges:
    from geokit.points.clouds import orientation_kernels as kernels

    count = len(normal)
    degree = wp.zeros(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.degree_kernel, count, [points, normal, reach, neighbor], [degree], device)
    begin, total = _starts(degree)
    end = wp.clone(begin)
    edge = wp.empty(total, dtype=wp.int64, device=device)
    launcher.launch(kernels.edge_kernel, count, [points, normal, reach, neighbor, bits], [end, edge], device)
    launcher.launch(kernels.sort_kernel, count, [begin, end], [edge], device)
    return _Edges(edge, begin, end)


def _vote(
    normal: "wp.array",
    neighbor: "wp.array",
    bits: int,
    rows: _Edges,
    link: "wp.array",
    best: "wp.array",
    hook: "wp.array",
    device: "wp.Device",
) -> None:
    """Join clusters by the votes of the edges between them until none is left."""
    from geokit.points.clouds import orientation_kernels as kernels

    count = len(normal)
    pair_bits = (count - 1).bit_length()
    given = [neighbor, bits, *rows, link]
    crossing = wp.empty(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.crossing_count_kernel, count, given, [crossing], device)
    offset, total = _starts(crossing)

    def room(size: int) -> list["wp.array"]:
        # radix_sort_pairs uses the second half of both arrays as scratch space.
        return [wp.empty(2 * size, dtype=wp.int64, device=device) for _ in range(2)]

    pair, vote = room(total)
    given = [normal, *given, offset, pair_bits]
    launcher.launch(kernels.crossing_kernel, count, given, [pair, vote], device)
    while total:
        # One more bit for what has become internal, which comes last.
        sort_pairs(pair, vote, total, end_bit=2 * pair_bits + 1)
        head = wp.empty(total, dtype=wp.int32, device=device)
        launcher.launch(kernels.head_kernel, total, [pair, pair_bits], [head], device)
        place, merged = prefix_sum(head)
        summed = room(merged)
        launcher.launch(kernels.sum_kernel, total, [pair, vote, total, head, place], summed, device)
        (pair, vote), total = summed, merged
        launcher.launch(kernels.best_pair_kernel, total, [pair, vote, pair_bits], [best], device)
        launcher.launch(kernels.hook_pair_kernel, count, [pair, vote, pair_bits, best], [hook], device)
        launcher.launch(kernels.apply_kernel, count, [hook], [link, best], device)
        launcher.launch(kernels.flatten_kernel, count, [], [link], device)
        launcher.launch(kernels.rename_kernel, total, [link, pair_bits], [pair, vote], device)


def _starts(count: "wp.array") -> tuple["wp.array", int]:
    """Exclusive prefix sum of counts, and their total."""
    start = wp.empty(len(count), dtype=wp.int32, device=count.device)
    wp.utils.array_scan(count, start, inclusive=False)
    return start, int(start[len(count) - 1 :].numpy()[0]) + int(count[len(count) - 1 :].numpy()[0])
