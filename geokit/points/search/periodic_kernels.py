"""Images of points in a periodic cell, and neighbor lists that name the point and the image of each neighbor."""

# mypy: ignore-errors
from typing import Any

import warp as wp

# The position of an image is rounded term by term, as a reference in NumPy rounds it.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class PeriodicCell:
    """The cell's vectors a, b and c [world], the inverse matrix, and how far beyond it images reach, in fractions."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d
    inverse: wp.mat33d
    reach: wp.vec3d


@wp.func
def translation(cell: PeriodicCell, s: wp.vec3i) -> wp.vec3d:
    return (wp.float64(s[0]) * cell.a + wp.float64(s[1]) * cell.b) + wp.float64(s[2]) * cell.c


@wp.func
def fractions(cell: PeriodicCell, p: wp.vec3d) -> wp.vec3d:
    """Coordinates along the cell's vectors."""
    return p * cell.inverse


@wp.func
def lowest_image(cell: PeriodicCell, f: wp.vec3d) -> wp.vec3i:
    s = wp.vec3i()
    for axis in range(3):
        s[axis] = wp.int32(wp.ceil(-cell.reach[axis] - f[axis]))
    return s


@wp.func
def highest_image(cell: PeriodicCell, f: wp.vec3d) -> wp.vec3i:
    s = wp.vec3i()
    for axis in range(3):
        s[axis] = wp.int32(wp.floor(wp.float64(1.0) + cell.reach[axis] - f[axis]))
    return s


@wp.kernel
def wrap_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    cell: PeriodicCell,
    out_points: wp.array(dtype=wp.vec3d),
    out_turn: wp.array(dtype=wp.vec3i),
):
    """Each point moved into the cell, and by how many of the cell's vectors it was outside."""
    i = first + wp.tid()
    f = fractions(cell, points[i])
    turn = wp.vec3i(wp.int32(wp.floor(f[0])), wp.int32(wp.floor(f[1])), wp.int32(wp.floor(f[2])))
    out_turn[i] = turn
    out_points[i] = points[i] - translation(cell, turn)


@wp.kernel
def image_count_kernel(
    first: int, points: wp.array(dtype=wp.vec3d), cell: PeriodicCell, out_count: wp.array(dtype=wp.int32)
):
    """Number of images of each point within reach of the cell, without the point itself."""
    i = first + wp.tid()
    f = fractions(cell, points[i])
    low = lowest_image(cell, f)
    high = highest_image(cell, f)
    out_count[i] = (high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1) - 1


@wp.kernel
def image_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    cell: PeriodicCell,
    end: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
    out_of: wp.array(dtype=wp.int32),
    out_shift: wp.array(dtype=wp.vec3i),
):
    """Each point, and after all points the images of each, ascending by point, then shift."""
    i = first + wp.tid()
    p = points[i]
    out_points[i] = p
    f = fractions(cell, p)
    low = lowest_image(cell, f)
    high = highest_image(cell, f)
    at = wp.int32(0)
    if i > 0:
        at = end[i - 1]
    for x in range(low[0], high[0] + 1):
        for y in range(low[1], high[1] + 1):
            for z in range(low[2], high[2] + 1):
                if x != 0 or y != 0 or z != 0:
                    s = wp.vec3i(x, y, z)
                    out_points[points.shape[0] + at] = p + translation(cell, s)
                    out_of[at] = i
                    out_shift[at] = s
                    at += 1


@wp.func
def is_before(s: wp.vec3i) -> wp.bool:
    """Whether a shift comes before that of the point itself, which is 0."""
    first = s[0]
    if first == 0:
        first = s[1]
    if first == 0:
        first = s[2]
    return first < 0


@wp.func
def is_image_next(
    point: wp.int32,
    image: wp.int32,
    end: wp.int32,
    points_end: wp.int32,
    index: wp.array(dtype=wp.int32),
    count: wp.int32,
    of: wp.array(dtype=wp.int32),
    shift: wp.array(dtype=wp.vec3i),
) -> wp.bool:
    """Whether the next image of a row comes before its next point, by point, then shift."""
    if image == end or point == points_end:
        return image < end
    g = index[image] - count
    return of[g] < index[point] or (of[g] == index[point] and is_before(shift[g]))


@wp.kernel
def list_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=Any),
    turn: wp.array(dtype=wp.vec3i),
    query_turn: wp.array(dtype=wp.vec3i),
    of: wp.array(dtype=wp.int32),
    shift: wp.array(dtype=wp.vec3i),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
    out_shift: wp.array(dtype=wp.vec3i),
):
    """Rows that ascend with the points before all images, sorted by point, then shift, and named as name_kernel does.

    With the shifts that shift_kernel finds, if there is room for them.
    """
    i = first + wp.tid()
    count = turn.shape[0]
    point = wp.int32(offset[i])
    end = wp.int32(offset[i + 1])
    # Where the images begin in the ascending row, after all points.
    points_end = wp.lower_bound(index, point, end + 1, count)
    image = points_end
    for at in range(wp.int32(offset[i]), end):
        s = wp.vec3i(0, 0, 0)
        taken = point
        j = wp.int32(0)
        if is_image_next(point, image, end, points_end, index, count, of, shift):
            taken = image
            image += 1
            j = of[index[taken] - count]
            s = shift[index[taken] - count]
        else:
            point += 1
            j = index[taken]
        out_index[at] = j
        out_distance[at] = distance[taken]
        if out_shift.shape[0] > 0:
            out_shift[at] = query_turn[i] + s - turn[j]


@wp.kernel
def name_kernel(first: int, count: wp.int32, of: wp.array(dtype=wp.int32), out_index: wp.array(dtype=wp.int32)):
    """The point of each neighbor, which may be an image."""
    i = first + wp.tid()
    if out_index[i] >= count:
        out_index[i] = of[out_index[i] - count]


@wp.kernel
def shift_kernel(
    first: int,
    offset: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
    turn: wp.array(dtype=wp.vec3i),
    query_turn: wp.array(dtype=wp.vec3i),
    of: wp.array(dtype=wp.int32),
    shift: wp.array(dtype=wp.vec3i),
    out_shift: wp.array(dtype=wp.vec3i),
):
    """Shift of each neighbor of each query, for points and queries where the caller has them."""
    i = first + wp.tid()
    for at in range(wp.int32(offset[i]), wp.int32(offset[i + 1])):
        j = index[at]
        s = query_turn[i]
        if j >= turn.shape[0]:
            s += shift[j - turn.shape[0]]
            j = of[j - turn.shape[0]]
        out_shift[at] = s - turn[j]


LIST = {
    real: wp.overload(list_kernel, {"distance": wp.array(dtype=real), "out_distance": wp.array(dtype=real)})
    for real in (wp.float64, wp.float32)
}
