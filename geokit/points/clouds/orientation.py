"""Consistent orientation of normals along a minimum spanning tree."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geokit.core import launcher
from geokit.errors import InputError

if TYPE_CHECKING:
    import warp as wp

__all__ = ["propagate_signs"]

# Each edge is listed twice, and the lists are counted in int32.
MAX_EDGES = 1 << 30
# The number of an edge has 32 bits beside the 32 bits of its weight.
NUMBER_BITS = 32


def propagate_signs(
    points: "wp.array", normal: "wp.array", order: "wp.array", neighbor: "wp.array", device: "wp.Device"
) -> None:
    """Orient normals in place along a minimum spanning tree, with the normal of each component's highest point up.

    Args:
        points: vec3d (N,).
        normal: vec3d (N,), unit length or zeros; zeros have no edges.
        order: The points in an order that puts neighbors close in memory, int32 (N,) or longer.
        neighbor: Neighbors of each point of the order, as positions in it, int32 (N, k), -1 for none.
        device: Device of the arrays.
    Raises:
        InputError: There are more than 2^30 edges, or 2^32 with k rounded up to a power of two.
    Source:
        Boruvka's algorithm: each round joins every component to another one by the least edge between them. An edge
        weighs 1 - abs(n_i . n_j) in float32; ties are broken by the edge's position, so that the tree is unique and the
        same on every device and for any number of threads.
    """
    import warp as wp

    from geokit.points.clouds import orientation_kernels as kernels

    count = len(points)
    # Number of bits of a column of the table.
    bits = (neighbor.shape[1] - 1).bit_length()
    if neighbor.size > MAX_EDGES or count > 1 << (NUMBER_BITS - bits):
        raise InputError(
            f"k: {count} points with {neighbor.shape[1]} neighbors each are too many edges to number; "
            "give a smaller k, or another orientation"
        )
    none = int(kernels.NONE)

    def filled(value: int) -> "wp.array":
        return wp.full(count, value, dtype=wp.int64, device=device)

    placed = wp.empty(count, dtype=wp.vec3d, device=device)
    link, best, hook = filled(0), filled(none), filled(-1)
    hooked = wp.zeros(1, dtype=wp.int32, device=device)
    launcher.launch(kernels.start_kernel, count, [order, normal], [placed, link], device)
    edge, begin, end = _edges(placed, neighbor, bits, device)
    while True:
        hooked.zero_()
        launcher.launch(kernels.best_edge_kernel, count, [neighbor, bits, edge, end, link], [begin, best], device)
        launcher.launch(kernels.hook_kernel, count, [placed, neighbor, bits, link, best], [hook, hooked], device)
        if not int(hooked.numpy()[0]):
            break
        launcher.launch(kernels.apply_kernel, count, [hook], [link, best], device)
        launcher.launch(kernels.flatten_kernel, count, [], [link], device)
    best.fill_(none)
    launcher.launch(kernels.highest_kernel, count, [points, order, link], [best], device)
    seed, turn = filled(none), hook
    launcher.launch(kernels.seed_kernel, count, [points, order, link, best], [seed], device)
    launcher.launch(kernels.turn_root_kernel, count, [placed, link, seed], [turn], device)
    launcher.launch(kernels.turn_kernel, count, [order, link, turn], [normal], device)


def _edges(
    normal: "wp.array", neighbor: "wp.array", bits: int, device: "wp.Device"
) -> tuple["wp.array", "wp.array", "wp.array"]:
    """The edges of each point, the least first, and the beginning and end of each row."""
    import warp as wp

    from geokit.points.clouds import orientation_kernels as kernels

    count = len(normal)
    degree = wp.zeros(count, dtype=wp.int32, device=device)
    launcher.launch(kernels.degree_kernel, count, [normal, neighbor], [degree], device)
    begin = wp.empty(count, dtype=wp.int32, device=device)
    wp.utils.array_scan(degree, begin, inclusive=False)
    total = int(begin[count - 1 :].numpy()[0]) + int(degree[count - 1 :].numpy()[0])
    end = wp.clone(begin)
    edge = wp.empty(total, dtype=wp.int64, device=device)
    launcher.launch(kernels.edge_kernel, count, [normal, neighbor, bits], [end, edge], device)
    launcher.launch(kernels.sort_kernel, count, [begin, end], [edge], device)
    return edge, begin, end
