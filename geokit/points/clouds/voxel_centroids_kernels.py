"""Voxels of points as keys, runs of equal keys, and the centroid of each run."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import begin_of

# Voxels and sums have the same bits on every device.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Points of a piece, which is summed separately: one thread's work on a GPU, where one voxel may hold all points.
PIECE = wp.constant(1024)


@wp.struct
class VoxelBox:
    """A box of voxels around the points."""

    voxel_size: wp.float64
    low: wp.vec3l  # its first voxel
    count: wp.vec3l  # voxels along each axis


@wp.func
def voxel_along(x: wp.float64, voxel_size: wp.float64) -> wp.int64:
    return wp.int64(wp.floor(x / voxel_size))


@wp.func
def voxel_number(p: wp.vec3d, box: VoxelBox) -> wp.int64:
    """Number of a point's voxel in the box; x varies fastest."""
    x = voxel_along(p[0], box.voxel_size) - box.low[0]
    y = voxel_along(p[1], box.voxel_size) - box.low[1]
    z = voxel_along(p[2], box.voxel_size) - box.low[2]
    return (z * box.count[1] + y) * box.count[0] + x


@wp.kernel
def key_kernel(first: int, points: wp.array(dtype=wp.vec3d), box: VoxelBox, out_key: wp.array(dtype=wp.int64)):
    """Number of each point's voxel."""
    i = first + wp.tid()
    out_key[i] = voxel_number(points[i], box)


@wp.kernel
def count_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    box: VoxelBox,
    length: wp.int32,
    voxel_count: wp.int32,
    out_key: wp.array(dtype=wp.int32),
    out_counts: wp.array(dtype=wp.int32),
):
    """Voxel number of each point of a share, and the number of the share's points in each voxel."""
    share = first + wp.tid()
    row = share * voxel_count
    for i in range(share * length, wp.min((share + 1) * length, points.shape[0])):
        key = wp.int32(voxel_number(points[i], box))
        out_key[i] = key
        out_counts[row + key] = out_counts[row + key] + 1


@wp.kernel
def scatter_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    key: wp.array(dtype=wp.int32),
    length: wp.int32,
    voxel_count: wp.int32,
    place: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
    out_index: wp.array(dtype=wp.int32),
):
    """Place the points of a share; ``place`` is the next free position of the share in each voxel."""
    share = first + wp.tid()
    row = share * voxel_count
    for i in range(share * length, wp.min((share + 1) * length, points.shape[0])):
        at = place[row + key[i]]
        place[row + key[i]] = at + 1
        out_points[at] = points[i]
        out_index[at] = i


@wp.kernel
def axis_key_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    voxel_size: wp.float64,
    axis: int,
    low: wp.int64,
    out_key: wp.array(dtype=wp.int64),
):
    """Number of each point's layer of voxels along one axis."""
    i = first + wp.tid()
    out_key[i] = voxel_along(points[i][axis], voxel_size) - low


@wp.kernel
def join_kernel(
    first: int,
    outer: wp.array(dtype=wp.int32),
    inner: wp.array(dtype=wp.int32),
    inner_count: wp.int64,
    out_key: wp.array(dtype=wp.int64),
):
    """Combine two numbers to one key; the inner one varies fastest."""
    i = first + wp.tid()
    out_key[i] = wp.int64(outer[i]) * inner_count + wp.int64(inner[i])


@wp.kernel
def head_kernel(first: int, key: wp.array(dtype=wp.int64), out_head: wp.array(dtype=wp.int32)):
    """1 where a sorted key differs from the previous one, else 0."""
    i = first + wp.tid()
    head = wp.int32(1)
    if i > 0 and key[i - 1] == key[i]:
        head = wp.int32(0)
    out_head[i] = head


@wp.kernel
def rank_kernel(
    first: int, order: wp.array(dtype=wp.int32), number: wp.array(dtype=wp.int32), out_rank: wp.array(dtype=wp.int32)
):
    """Scatter the ranks of the sorted keys, from 0, back to the original positions of the keys."""
    i = first + wp.tid()
    out_rank[order[i]] = number[i] - 1


@wp.kernel
def begin_kernel(first: int, number: wp.array(dtype=wp.int32), out_begin: wp.array(dtype=wp.int32)):
    """First sorted position of each run; the last entry is the number of positions."""
    i = first + wp.tid()
    n = number.shape[0]
    if i == 0 or number[i - 1] != number[i]:
        out_begin[number[i] - 1] = i
    if i == n - 1:
        out_begin[number[i]] = n


@wp.func
def sum_of_piece(points: wp.array(dtype=wp.vec3d), origin: wp.vec3d, begin: wp.int32, end: wp.int32) -> wp.vec3d:
    """Sum of a run of points relative to ``origin``."""
    total = wp.vec3d()
    for k in range(begin, end):
        total += points[k] - origin
    return total


@wp.func
def squared_from(p: wp.vec3d, origin: wp.vec3d, mean: wp.vec3d) -> wp.float64:
    d = (p - origin) - mean
    return (d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]


@wp.func
def nearest_in_piece(
    points: wp.array(dtype=wp.vec3d), origin: wp.vec3d, mean: wp.vec3d, begin: wp.int32, end: wp.int32
) -> wp.int32:
    """The first of a run's points that are nearest to ``origin + mean``."""
    nearest = wp.float64(wp.inf)
    at = begin
    for k in range(begin, end):
        squared = squared_from(points[k], origin, mean)
        if squared < nearest:
            nearest = squared
            at = k
    return at


@wp.kernel
def centroid_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32),
    begin: wp.array(dtype=wp.int32),
    out_centroid: wp.array(dtype=wp.vec3d),
    out_index: wp.array(dtype=wp.int32),
):
    """Centroid of each run, and the point nearest to it; among ties the one with the lowest index.

    Sums are relative to the run's first point, in the order of the indices, in pieces of PIECE points. So no digits are
    lost far from the origin, and one thread for each piece gives the same bits.
    """
    i = first + wp.tid()
    b = begin[i]
    e = begin[i + 1]
    origin = points[b]
    total = wp.vec3d()
    for piece in range(b, e, PIECE):
        total += sum_of_piece(points, origin, piece, wp.min(piece + PIECE, e))
    mean = total / wp.float64(e - b)
    out_centroid[i] = origin + mean
    out_index[i] = index[nearest_in_piece(points, origin, mean, b, e)]


@wp.kernel
def piece_count_kernel(first: int, begin: wp.array(dtype=wp.int32), out_count: wp.array(dtype=wp.int32)):
    """Number of pieces of each run."""
    i = first + wp.tid()
    out_count[i] = (begin[i + 1] - begin[i] + PIECE - 1) // PIECE


@wp.func
def piece_of(piece: wp.int32, begin: wp.array(dtype=wp.int32), piece_end: wp.array(dtype=wp.int32)) -> wp.vec3i:
    """The run of a piece, which is the first run whose pieces end after it, and the piece's positions: begin, end."""
    run = wp.lower_bound(piece_end, piece + 1)
    b = begin[run] + (piece - begin_of(piece_end, run)) * PIECE
    return wp.vec3i(run, b, wp.min(b + PIECE, begin[run + 1]))


@wp.kernel
def piece_sum_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    begin: wp.array(dtype=wp.int32),
    piece_end: wp.array(dtype=wp.int32),
    out_sum: wp.array(dtype=wp.vec3d),
):
    """Sum of each piece relative to its run's first point."""
    piece = first + wp.tid()
    at = piece_of(piece, begin, piece_end)
    out_sum[piece] = sum_of_piece(points, points[begin[at[0]]], at[1], at[2])


@wp.kernel
def mean_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    begin: wp.array(dtype=wp.int32),
    piece_end: wp.array(dtype=wp.int32),
    piece_sum: wp.array(dtype=wp.vec3d),
    out_mean: wp.array(dtype=wp.vec3d),
    out_centroid: wp.array(dtype=wp.vec3d),
):
    """Centroid of each run from the sums of its pieces, relative to its first point and in world coordinates."""
    i = first + wp.tid()
    before = begin_of(piece_end, i)
    total = wp.vec3d()
    for piece in range(before, piece_end[i]):
        total += piece_sum[piece]
    mean = total / wp.float64(begin[i + 1] - begin[i])
    out_mean[i] = mean
    out_centroid[i] = points[begin[i]] + mean


@wp.kernel
def piece_nearest_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    begin: wp.array(dtype=wp.int32),
    piece_end: wp.array(dtype=wp.int32),
    mean: wp.array(dtype=wp.vec3d),
    out_at: wp.array(dtype=wp.int32),
):
    """Position of the point of each piece nearest to the centroid of its run."""
    piece = first + wp.tid()
    at = piece_of(piece, begin, piece_end)
    out_at[piece] = nearest_in_piece(points, points[begin[at[0]]], mean[at[0]], at[1], at[2])


@wp.kernel
def nearest_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32),
    begin: wp.array(dtype=wp.int32),
    piece_end: wp.array(dtype=wp.int32),
    mean: wp.array(dtype=wp.vec3d),
    piece_at: wp.array(dtype=wp.int32),
    out_index: wp.array(dtype=wp.int32),
):
    """The point of each run nearest to its centroid, selected among the candidates of its pieces."""
    i = first + wp.tid()
    before = begin_of(piece_end, i)
    origin = points[begin[i]]
    nearest = wp.float64(wp.inf)
    at = begin[i]
    for piece in range(before, piece_end[i]):
        squared = squared_from(points[piece_at[piece]], origin, mean[i])
        if squared < nearest:
            nearest = squared
            at = piece_at[piece]
    out_index[i] = index[at]
