"""Derivatives of distances between points by both ends."""

from typing import Any

# mypy: ignore-errors
import warp as wp

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def pair_slopes_kernel(
    first: int,
    queries: wp.array(dtype=Any),
    points: wp.array(dtype=Any),
    offsets: wp.array(dtype=wp.int64),
    width: int,
    indices: wp.array(dtype=int),
    shifts: wp.array(dtype=int),
    cell: wp.mat33d,
    by_distance: wp.array(dtype=Any),
    begin: int,
    out_queries: wp.array(dtype=wp.vec3d),
    out_query: wp.array(dtype=int),
    out_points: wp.array(dtype=wp.vec3d),
    out_point: wp.array(dtype=int),
):
    """The slopes of a query, and of the point of each of its distances, with the numbers of both.

    A query has the distances from ``offsets`` on, or ``width`` of them where there are none. Its own slope is written
    from row ``begin`` on. Outputs that are not wanted have no rows; a distance of 0 or to no point has the slope 0.
    """
    i = first + wp.tid()
    start = width * i
    stop = start + width
    if offsets.shape[0] > 0:
        start = int(offsets[i])
        stop = int(offsets[i + 1])
    q = wp.vec3d(queries[i])
    total = wp.vec3d()
    for pair in range(start, stop):
        slope = wp.vec3d()
        point = indices[pair]
        if point >= 0:
            there = wp.vec3d(points[point])
            if shifts.shape[0] > 0:
                for axis in range(3):
                    there += wp.float64(shifts[3 * pair + axis]) * cell[axis]
            away = q - there
            length = wp.length(away)
            if length > wp.float64(0.0):
                slope = (wp.float64(by_distance[pair]) / length) * away
        total += slope
        if out_points.shape[0] > 0:
            out_points[pair] = -slope
            out_point[pair] = wp.max(point, 0)
    if out_queries.shape[0] > 0:
        out_queries[begin + i] = total
        out_query[begin + i] = i


_VECTORS = {wp.float32: wp.vec3f, wp.float64: wp.vec3d}
_SINGLE, _DOUBLE = wp.float32, wp.float64
# By the types of the distances, of the queries and of the points.
PAIR_SLOPES = {
    (distance, query, point): wp.overload(
        pair_slopes_kernel,
        {
            "by_distance": wp.array(dtype=distance),
            "queries": wp.array(dtype=_VECTORS[query]),
            "points": wp.array(dtype=_VECTORS[point]),
        },
    )
    for distance, query, point in (
        (_SINGLE, _SINGLE, _SINGLE),
        (_SINGLE, _SINGLE, _DOUBLE),
        (_SINGLE, _DOUBLE, _DOUBLE),
        (_DOUBLE, _DOUBLE, _DOUBLE),
    )
}
