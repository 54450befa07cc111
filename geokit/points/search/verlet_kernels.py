"""Verlet lists: candidates within the radius and a skin, which stay while points move, compared exactly each time."""

# mypy: ignore-errors
from typing import Any

import warp as wp

from geokit.core import cpp
from geokit.points.search.periodic_kernels import PeriodicCell, fractions, is_before, translation

# The squared distance and the position of an image are rounded term by term, as in a search.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# Lists between the prefetch of a row and its write.
AHEAD = wp.constant(12)


@wp.struct
class VerletLists:
    """Lists of candidates. Places are those of the points, and of their images, sorted by cell when lists were made.

    List k is ``near[start[k]] .. near[start[k + 1] - 1]``: places, by ascending point, then shift. It is that of point
    ``point[k]``, which is at ``place[k]``. ``at`` holds where each place is now, and a number that names it: its point,
    or in a periodic cell the place.

    In a periodic cell ``inside`` are the points in the cell, now, ``shift`` the vectors of the cell by which each place
    is moved, and ``drift`` by how many of them each point has been wrapped since the lists were made.
    """

    near: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.int64)
    point: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.int32)
    of: wp.array(dtype=wp.int32)
    at: wp.array(dtype=wp.vec4d)
    cell: PeriodicCell
    inside: wp.array(dtype=wp.vec3d)
    shift: wp.array(dtype=wp.vec3i)
    drift: wp.array(dtype=wp.vec3i)


@cpp.func_native("points/search/verlet.inl")
def near_count() -> wp.int32: ...


@cpp.func_native("points/search/verlet.inl")
def near_fill(out_distance: wp.array(dtype=Any)): ...


@wp.func
def is_wrapped(lists: VerletLists, i: wp.int32) -> wp.bool:
    """Whether the images in ``at`` are not those that point i sees."""
    wrapped = wp.bool(False)
    if lists.drift.shape[0] > 0:
        d = lists.drift[i]
        wrapped = d[0] != 0 or d[1] != 0 or d[2] != 0
    return wrapped


@wp.func
def square_seen(lists: VerletLists, i: wp.int32, p: wp.int32) -> wp.float64:
    """Squared distance from point i of the image at a place, as point i sees it."""
    j = lists.of[p]
    d = (lists.inside[j] + translation(lists.cell, lists.shift[p] + lists.drift[i] - lists.drift[j])) - lists.inside[i]
    return (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]


@wp.func
def list_of(lists: VerletLists, k: wp.int32, exclude_self: wp.int32):
    """Begin and end of a list, and the place that it leaves out, -1 for none."""
    own = wp.int32(-1)
    if exclude_self != 0:
        own = lists.place[k]
    return wp.int32(lists.start[k]), wp.int32(lists.start[k + 1]), own


@wp.kernel
def count_kernel(
    first: int,
    lists: VerletLists,
    limit: wp.float64,
    exclude_self: wp.int32,
    out_count: wp.array(dtype=wp.int32),
):
    """Number of candidates of each list within the radius."""
    k = first + wp.tid()
    i = lists.point[k]
    begin, end, own = list_of(lists, k, exclude_self)
    if is_wrapped(lists, i):
        found = wp.int32(0)
        for c in range(begin, end):
            if lists.near[c] != own and square_seen(lists, i, lists.near[c]) <= limit:
                found += 1
        out_count[i] = found
    else:
        out_count[i] = near_count(lists.at, lists.near, begin, end, lists.place[k], own, limit)


@wp.kernel
def fill_kernel(
    first: int,
    lists: VerletLists,
    limit: wp.float64,
    exclude_self: wp.int32,
    offset: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
):
    """Candidates of each list within the radius: points, places in a periodic cell, and distances."""
    k = first + wp.tid()
    i = lists.point[k]
    begin, end, own = list_of(lists, k, exclude_self)
    # Flat results have fewer than 2^31 entries, which the caller ensures.
    to = wp.int32(offset[i])
    if is_wrapped(lists, i):
        for c in range(begin, end):
            p = lists.near[c]
            square = square_seen(lists, i, p)
            if p != own and square <= limit:
                out_index[to] = p
                out_distance[to] = out_distance.dtype(wp.sqrt(square))
                to += 1
    else:
        # The row of a list that comes soon.
        row = lists.point[wp.min(k + AHEAD, lists.point.shape[0] - 1)]
        next = offset[row]
        soon = offset[row + 1] - next
        place = lists.place[k]
        near_fill(lists.at, lists.near, begin, end, place, own, limit, next, soon, to, out_index, out_distance)


@wp.kernel
def move_kernel(
    first: int, points: wp.array(dtype=wp.vec3d), of: wp.array(dtype=wp.int32), out_at: wp.array(dtype=wp.vec4d)
):
    """Where each place is now, with its point."""
    p = first + wp.tid()
    x = points[of[p]]
    out_at[p] = wp.vec4d(x[0], x[1], x[2], wp.float64(of[p]))


@wp.kernel
def move_images_kernel(first: int, lists: VerletLists, out_at: wp.array(dtype=wp.vec4d)):
    """Where each place is now for points that have not been wrapped since, with its number."""
    p = first + wp.tid()
    j = lists.of[p]
    x = lists.inside[j] + translation(lists.cell, lists.shift[p] - lists.drift[j])
    out_at[p] = wp.vec4d(x[0], x[1], x[2], wp.float64(p))


@wp.kernel
def drift_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    turn: wp.array(dtype=wp.vec3i),
    before: wp.array(dtype=wp.vec3d),
    turn_before: wp.array(dtype=wp.vec3i),
    cell: PeriodicCell,
    out_drift: wp.array(dtype=wp.vec3i),
    out_before: wp.array(dtype=wp.vec3d),
    out_leap: wp.array(dtype=wp.vec3i),
    out_has_leapt: wp.array(dtype=wp.int32),
):
    """By how many of the cell's vectors each point was wrapped, and where it was before if wrapped by as many.

    ``out_leap`` is by how many the caller has moved it, and ``out_has_leapt`` becomes 1 if one was.
    """
    i = first + wp.tid()
    f = fractions(cell, points[i] - before[i])
    drift = wp.vec3i(wp.int32(wp.rint(f[0])), wp.int32(wp.rint(f[1])), wp.int32(wp.rint(f[2])))
    out_drift[i] = drift
    out_before[i] = before[i] + translation(cell, drift)
    leap = drift + turn[i] - turn_before[i]
    out_leap[i] = leap
    if leap[0] != 0 or leap[1] != 0 or leap[2] != 0:
        out_has_leapt[0] = 1


@wp.kernel
def motion_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    before: wp.array(dtype=wp.vec3d),
    rows: wp.int32,
    apart: wp.int32,
    step: wp.int32,
    out_square: wp.array(dtype=wp.float64),
):
    """Largest squared motion of ``rows`` points, ``step`` apart, from ``apart`` times the item on."""
    item = first + wp.tid()
    most = wp.float64(0.0)
    for row in range(rows):
        i = item * apart + row * step
        if i < points.shape[0]:
            d = points[i] - before[i]
            most = wp.max(most, d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    out_square[item] = most


@wp.kernel
def inverse_kernel(first: int, order: wp.array(dtype=wp.int32), out_place: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out_place[order[i]] = i


@wp.kernel
def rank_kernel(
    first: int,
    index: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    of: wp.array(dtype=wp.int32),
    shift: wp.array(dtype=wp.vec3i),
    out_rank: wp.array(dtype=wp.int32),
    out_of: wp.array(dtype=wp.int32),
    out_shift: wp.array(dtype=wp.vec3i),
):
    """Rank of each place among all points and images, by point, then shift; its point, and its shift.

    ``end`` is the end of the images of each point, ``index`` numbers the images after all points.
    """
    p = first + wp.tid()
    count = end.shape[0]
    e = index[p]
    if e < count:
        at = wp.int32(0)
        if e > 0:
            at = end[e - 1]
        while at < end[e] and is_before(shift[at]):
            at += 1
        out_rank[p] = e + at
        out_of[p] = e
        out_shift[p] = wp.vec3i(0, 0, 0)
    else:
        g = e - count
        rank = g + of[g]
        if not is_before(shift[g]):
            rank += 1
        out_rank[p] = rank
        out_of[p] = of[g]
        out_shift[p] = shift[g]


@wp.kernel
def candidate_count_kernel(first: int, lists: VerletLists, exclude_self: wp.int32, out_count: wp.array(dtype=wp.int32)):
    """Length of each list."""
    k = first + wp.tid()
    out_count[lists.point[k]] = wp.int32(lists.start[k + 1] - lists.start[k]) - exclude_self


# Warp accesses arrays through their strides: the same loop takes twice as long on a CPU.
@wp.func_native("""
for (int c = begin; c < end; ++c) {
    const int p = lists.near.data[c];
    if (p != own) out_index.data[to++] = lists.of.data[p];
}
""")
def name_places(
    lists: VerletLists, begin: wp.int32, end: wp.int32, own: wp.int32, to: wp.int32, out_index: wp.array(dtype=wp.int32)
):
    """Write the points of a list, without that at place ``own``."""
    ...


@wp.kernel
def candidate_kernel(
    first: int,
    lists: VerletLists,
    exclude_self: wp.int32,
    turn: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    out_index: wp.array(dtype=wp.int32),
    out_shift: wp.array(dtype=wp.int32, ndim=2),
):
    """Points of each list, in the order of the points; in a periodic cell with their shifts when it was made."""
    k = first + wp.tid()
    i = lists.point[k]
    begin, end, own = list_of(lists, k, exclude_self)
    name_places(lists, begin, end, own, wp.int32(offset[i]), out_index)
    if turn.shape[0] > 0:
        to = wp.int32(offset[i])
        for c in range(begin, end):
            p = lists.near[c]
            if p != own:
                s = lists.shift[p] + turn[i] - turn[lists.of[p]]
                for axis in range(3):
                    out_shift[to, axis] = s[axis]
                to += 1


@wp.kernel
def leap_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
    leap: wp.array(dtype=wp.vec3i),
    shift: wp.array(dtype=wp.int32, ndim=2),
    out_shift: wp.array(dtype=wp.int32, ndim=2),
):
    """Shifts of candidates whose points the caller has moved by whole cells since."""
    i = first + wp.tid()
    for c in range(wp.int32(offset[i]), wp.int32(offset[i + 1])):
        s = leap[i] - leap[index[c]]
        for axis in range(3):
            out_shift[c, axis] = shift[c, axis] + s[axis]


@wp.kernel
def shift_kernel(
    first: int,
    lists: VerletLists,
    turn: wp.array(dtype=wp.vec3i),
    offset: wp.array(dtype=wp.int64),
    places: wp.array(dtype=wp.int32),
    out_shift: wp.array(dtype=wp.int32, ndim=2),
):
    """Shift of each neighbor of each point, for points where the caller has them, which are ``turn`` from the cell."""
    i = first + wp.tid()
    for c in range(wp.int32(offset[i]), wp.int32(offset[i + 1])):
        p = places[c]
        j = lists.of[p]
        s = (lists.shift[p] + lists.drift[i] - lists.drift[j]) + (turn[i] - turn[j])
        for axis in range(3):
            out_shift[c, axis] = s[axis]


FILL = {real: wp.overload(fill_kernel, {"out_distance": wp.array(dtype=real)}) for real in (wp.float64, wp.float32)}
