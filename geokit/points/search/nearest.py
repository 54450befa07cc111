"""Exact k nearest neighbors of each query, on the CPU and on a GPU."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop.types import Array
from geokit.core.launches import captured
from geokit.core.memory import available_memory
from geokit.core.require import described, whole_number
from geokit.errors import InputError
from geokit.points.search.nearest_tree import (
    blocks_in_order,
    curve_order,
    frame_of,
    group_order,
    group_spans,
)

# Longest list; for more neighbors radius_search is better suited.
MAX_K = 1024
# Items of the search that are worth a slice; each has 128 queries.
GROUP_GRAIN = 8
# Fewest teams that answer more than one query each: as many as a GPU runs at once.
LEAST_TEAMS = 8192
# How much farther than a query's k-th point that of the next one may be, relative to what chance gives.
STRETCH = 1.7
# Bytes of an entry: int32 index and float64 distance.
BYTES_PER_NEIGHBOR = 12


class KNearest(NamedTuple):
    """The k nearest points of each of Q queries, the nearest first; ties in order of index.

    Attributes:
        distance: Distances of the points from the query [world], inf where there are fewer; shape (Q, k).
        indices: Indices of the points, -1 where there are fewer; shape (Q, k) int32.
    """

    distance: Array
    indices: Array


def require_k(k: Any) -> int:
    """Check ``k`` and return it as an int.

    Raises:
        InputError: k is not a whole number from 1 to MAX_K.
    """
    number = whole_number(k)
    if number is None:
        raise InputError(f"k: {described(k)} is not a whole number; give one from 1 to {MAX_K}")
    if not 1 <= number <= MAX_K:
        raise InputError(f"k: {described(number)} is not from 1 to {MAX_K}; use radius_search for more neighbors")
    return number


def nearest(
    tree: Any,
    k: int,
    queries: "wp.array | None",
    *,
    limit_squared: "wp.array | float" = np.inf,
    exclude_self: bool = False,
    groups: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None,
) -> tuple["wp.array", "wp.array"]:
    """Find the k points with the smallest (squared distance, index) of each query.

    Exact: the squared distance is ``(dx * dx + dy * dy) + dz * dz`` in float64, each operation rounded once, and the
    distance is its rounded root.

    Args:
        tree: A tree made by build_tree.
        k: From 1 to MAX_K.
        queries: vec3d positions (Q,) [world], finite, on the tree's device; None for the tree's points.
        limit_squared: Squared distance [world] up to which points are found, the limit included: a number, or a
            float64 array (Q,).
        exclude_self: Query i does not find point i.
        groups: Offsets of the groups of the tree's points, for which it was built, and of the queries, as many.
    Returns:
        distance (Q, k) float64 [world], inf where there are fewer points, and indices (Q, k) int32, -1 there.
    Raises:
        DeviceMemoryError: The results do not fit in memory; nothing has been allocated for them.
    """
    from geokit.points.search import nearest_tree_kernels as tree_kernels

    device = tree.positions.device
    count = tree.count if queries is None else len(queries)
    what, remedy = f"knn: the {k} nearest points of {count} queries need", "use a smaller k or fewer queries at a time"
    available_memory.require_room(count * k * BYTES_PER_NEIGHBOR, what, remedy, device)
    out = tree_kernels.NearestQueries()
    out.count, out.k, out.seeded, out.excluded = count, k, int(queries is None), int(exclude_self)
    out.distance = wp.empty((count, k), dtype=wp.float64, device=device)
    out.indices = wp.empty((count, k), dtype=wp.int32, device=device)
    if count == 0 or tree.count == 0:
        out.distance.fill_(np.inf)
        out.indices.fill_(-1)
        return out.distance, out.indices
    if groups is not None:
        spans, group, _ = group_spans(groups[1])
        first = group_spans(groups[0])[2]
        out.leaves = wp.array(np.stack([first[group], first[group + 1]], axis=1), dtype=wp.vec2i, device=device)
        count = out.count = len(spans) * int(tree_kernels.LEAF)
    if queries is None:
        out.positions, out.index = tree.positions, tree.index
    elif groups is not None:
        out.positions, out.index = blocks_in_order(queries, group_order(queries, groups[1]), device, spans)
    else:
        # Queries of one block are answered together, in any order.
        is_block = device.is_cpu and count <= int(tree_kernels.LEAF)
        if is_block:
            order = launcher.identity(device)
        else:
            # That of queries is read on the host, which has no part in a graph.
            frame = tree.frame if captured.is_captured(device) else frame_of(queries)
            order = curve_order(queries, frame, device)[1]
        out.positions, out.index = blocks_in_order(queries, order, device)
    is_each = isinstance(limit_squared, wp.array)
    out.limit_squared = limit_squared if is_each else wp.full(1, limit_squared, dtype=wp.float64, device=device)
    kernel, items, out.run = _search_kernel(k, count, device)
    out.stretch = 1.0 + STRETCH / math.sqrt(k)
    launcher.launch(kernel, items, [tree], [out], device, grain=GROUP_GRAIN)
    return out.distance, out.indices


def _search_kernel(k: int, count: int, device: Any) -> tuple[Any, int, int]:
    """The kernel for lists of k on the device, its number of items for ``count`` queries, and the queries of each."""
    if device.is_cpu:
        from geokit.points.search import nearest_cpu_kernels as wide
        from geokit.points.search.nearest_tree_kernels import LEAF

        queries = int(LEAF) * int(wide.BLOCKS)
        return wide.nearest_kernel, -(-count // queries), queries
    from geokit.points.search import nearest_cuda_kernels as cuda

    if k <= 8:
        return cuda.nearest_8_kernel, count, 1
    run = next(run for run in (16, 8, 4, 2, 1) if count >= run * LEAST_TEAMS or run == 1)
    table = (32, cuda.nearest_32_kernel, 32), (128, cuda.nearest_128_kernel, 32), (MAX_K, cuda.nearest_1024_kernel, 128)
    kernel, threads = next((kernel, threads) for longest, kernel, threads in table if k <= longest)
    return kernel, -(-count // run) * threads, run
