"""The neighbours of a query, read from x-rows of cells.

Every comparison is made on the caller's float64 coordinates with the roundings written down, so that the answer is the
one that ``(dx * dx + dy * dy) + dz * dz <= radius * radius`` gives anywhere else.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.points._cells_kernels import MASK_BITS, CellGrid, cell_along, cell_key

# Fused multiply-adds would round the squared distance once instead of five times: points at exactly the radius would
# be in or out by the compiler's mood.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class CellBox:
    """The cells that a query's cube touches, both corners inclusive; empty where an upper one is below a lower one."""

    lower: wp.vec3i
    upper: wp.vec3i


@wp.func
def cells_around(grid: CellGrid, q: wp.vec3d, reach: wp.float64) -> CellBox:
    """Cells of the cube of half edge ``reach`` around ``q``."""
    box = CellBox()
    for axis in range(3):
        low = q[axis] - reach
        high = q[axis] + reach
        box.lower[axis] = cell_along(grid, axis, low)
        box.upper[axis] = cell_along(grid, axis, high)
        # Clamping alone would have a far query read the cells at the border.
        if high < grid.lower[axis] or low > grid.upper[axis]:
            box.upper[axis] = -1
    return box


@wp.func
def first_at_or_above(grid: CellGrid, key: wp.int64) -> wp.int32:
    """The first sorted point whose key is not below ``key``."""
    bucket = wp.int32(key >> wp.int64(grid.shift))
    begin = grid.start[bucket]
    # A key that opens its bucket needs no search; with shift 0 every key does.
    if (key & ((wp.int64(1) << wp.int64(grid.shift)) - wp.int64(1))) != wp.int64(0):
        end = grid.start[bucket + 1]
        while begin < end:
            middle = begin + (end - begin) // 2
            if grid.key[middle] < key:
                begin = middle + 1
            else:
                end = middle
    return begin


@wp.func
def row_count(box: CellBox) -> wp.int32:
    """Number of x-rows of cells in the box."""
    rows = wp.int32(0)
    if box.lower[0] <= box.upper[0] and box.lower[1] <= box.upper[1] and box.lower[2] <= box.upper[2]:
        rows = (box.upper[1] - box.lower[1] + 1) * (box.upper[2] - box.lower[2] + 1)
    return rows


@wp.func
def row_range(grid: CellGrid, box: CellBox, row: wp.int32) -> wp.vec2i:
    """Begin and end of the sorted points in one x-row of the box: neighbours in x are neighbours in memory."""
    width = box.upper[1] - box.lower[1] + 1
    y = box.lower[1] + row % width
    z = box.lower[2] + row // width
    begin = first_at_or_above(grid, cell_key(grid, box.lower[0], y, z))
    end = first_at_or_above(grid, cell_key(grid, box.upper[0] + 1, y, z))
    return wp.vec2i(begin, end)


# warp has no vectors of eight doubles and no way from a comparison of them to a bit mask: on the CPU this reads eight
# points at a time. Both branches round alike, lane by lane.
WITHIN_MASK = """
    uint64_t mask = 0;
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < count; ++k) {
        const double dx = x.data[begin + k] - qx;
        const double dy = y.data[begin + k] - qy;
        const double dz = z.data[begin + k] - qz;
        const double d = (dx * dx + dy * dy) + dz * dz;
        mask |= uint64_t(d <= radius_squared) << k;
    }
#else
    typedef double lanes __attribute__((ext_vector_type(8), aligned(8)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    const lanes limit = (lanes)(radius_squared);
    for (int k = 0; k < count; k += 8) {
        const lanes dx = *(const lanes*)(x.data + begin + k) - (lanes)(qx);
        const lanes dy = *(const lanes*)(y.data + begin + k) - (lanes)(qy);
        const lanes dz = *(const lanes*)(z.data + begin + k) - (lanes)(qz);
        const lanes d = (dx * dx + dy * dy) + dz * dz;
        const flags inside = __builtin_convertvector(d <= limit, flags);
        mask |= uint64_t(__builtin_bit_cast(unsigned char, inside)) << k;
    }
    if (count < 64)
        mask &= (uint64_t(1) << count) - 1;
#endif
    return mask;
"""


@wp.func_native(WITHIN_MASK)
def within_mask_of(
    x: wp.array(dtype=wp.float64),
    y: wp.array(dtype=wp.float64),
    z: wp.array(dtype=wp.float64),
    begin: wp.int32,
    count: wp.int32,
    qx: wp.float64,
    qy: wp.float64,
    qz: wp.float64,
    radius_squared: wp.float64,
) -> wp.uint64: ...


@wp.func
def within_mask(grid: CellGrid, begin: wp.int32, end: wp.int32, q: wp.vec3d, radius_squared: wp.float64) -> wp.uint64:
    """Bit k is set where the sorted point ``begin + k`` is within the radius, among MASK_BITS points at most."""
    count = wp.min(end - begin, MASK_BITS)
    return within_mask_of(grid.x, grid.y, grid.z, begin, count, q[0], q[1], q[2], radius_squared)


# warp 1.19 has neither of these two bit counts.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popcll(mask);
#else
    return __builtin_popcountll(mask);
#endif
""")
def bit_count(mask: wp.uint64) -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffsll((long long)mask) - 1;
#else
    return __builtin_ctzll(mask);
#endif
""")
def lowest_bit(mask: wp.uint64) -> wp.int32: ...


# In warp's own language each access to an array goes through its strides: the same loop takes 1.7 times as long on the
# CPU.
SORT_BY_INDEX = """
    int* const key = index.data + begin;
    double* const value = distance.data + begin;
    int gap = count;
    while (gap > 1) {
        gap = gap <= 32 ? 1 : gap / 9 * 4;
        for (int i = gap; i < count; ++i) {
            const int moving = key[i];
            if (key[i - gap] <= moving)
                continue;
            const double moving_value = value[i];
            int j = i;
            do {
                key[j] = key[j - gap];
                value[j] = value[j - gap];
                j -= gap;
            } while (j >= gap && key[j - gap] > moving);
            key[j] = moving;
            value[j] = moving_value;
        }
    }
"""


@wp.func_native(SORT_BY_INDEX)
def sort_by_index(
    begin: wp.int32, count: wp.int32, index: wp.array(dtype=wp.int32), distance: wp.array(dtype=wp.float64)
):
    """Sorts ``count`` entries of both arrays from ``begin`` on by ascending index, in place.

    Source: Shell's sort with the gap ratio 9/4 of Tokuda (1992). It needs no stack and no second buffer, which a
    thread per row does not have, and stays close to n log n.
    """
    ...


@wp.kernel
def count_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    queries: wp.array(dtype=wp.vec3d),
    grid: CellGrid,
    reach: wp.float64,
    radius_squared: wp.float64,
    out_count: wp.array(dtype=wp.int32),
):
    """Number of neighbours of each query."""
    i = order[first + wp.tid()]
    q = queries[i]
    box = cells_around(grid, q, reach)
    found = wp.int32(0)
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            found += bit_count(within_mask(grid, begin, span[1], q, radius_squared))
    out_count[i] = found


@wp.kernel
def fill_kernel(
    first: int,
    order: wp.array(dtype=wp.int32),
    queries: wp.array(dtype=wp.vec3d),
    offset: wp.array(dtype=wp.int64),
    grid: CellGrid,
    reach: wp.float64,
    radius_squared: wp.float64,
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=wp.float64),
):
    """Neighbours of each query from its offset on, by ascending index."""
    i = order[first + wp.tid()]
    q = queries[i]
    box = cells_around(grid, q, reach)
    # Flat results have fewer than 2^31 entries: the caller sees to it.
    row_begin = wp.int32(offset[i])
    at = row_begin
    for row in range(row_count(box)):
        span = row_range(grid, box, row)
        for begin in range(span[0], span[1], MASK_BITS):
            mask = within_mask(grid, begin, span[1], q, radius_squared)
            while mask != wp.uint64(0):
                j = begin + lowest_bit(mask)
                mask = mask & (mask - wp.uint64(1))
                dx = grid.x[j] - q[0]
                dy = grid.y[j] - q[1]
                dz = grid.z[j] - q[2]
                out_index[at] = grid.index[j]
                out_distance[at] = wp.sqrt((dx * dx + dy * dy) + dz * dz)
                at += 1
    sort_by_index(row_begin, at - row_begin, out_index, out_distance)


@wp.kernel
def offset_kernel(first: int, count: wp.array(dtype=wp.int32), out_offset: wp.array(dtype=wp.int64)):
    """Counts as int64, ready to be summed in place."""
    i = first + wp.tid()
    out_offset[i] = wp.int64(count[i])
