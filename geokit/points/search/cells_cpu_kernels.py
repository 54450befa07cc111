"""Points sorted by cell on a CPU, by counting: each thread counts a share of them, then says where each point goes.

Counting needs no comparison and no second copy of the keys: where there are not many more cells than points, and few
threads, it is several times as quick as a sort. What is scattered is four bytes a point; coordinates are then gathered
in order, since a processor reads what lies apart sooner than it writes it.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

from geokit.points.search.cells_kernels import CellGrid

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Points of an item that gathers.
GATHERED = wp.constant(1 << 12)

# As cell_along in cells_kernels, in C++: both must find the same cell. Names that the text expects: grid.
CELL_ALONG = """
    auto cell_along = [&](int axis, double at) -> int {
        int i = grid.first_cut[axis];
        for (int last = grid.last_cut[axis]; i < last;) {
            const int middle = (i + last + 1) / 2;
            if (grid.cut.data[middle][0] <= at)
                i = middle;
            else
                last = middle - 1;
        }
        const auto& cut = grid.cut.data[i];
        const double top = cut[3] - 1.0, cell = (at - cut[0]) * cut[1];
        return (int)(cut[2]) + (int)(cell > 0.0 ? (cell < top ? cell : top) : 0.0);
    };
"""

TALLY = (
    """
#if !defined(__CUDA_ARCH__)
    typedef decltype(points.data[0][0] + points.data[0][0]) real;
    typedef real given __attribute__((ext_vector_type(8), aligned(4)));
    typedef double numbers __attribute__((ext_vector_type(8)));
    typedef int integers __attribute__((ext_vector_type(8)));
"""
    + CELL_ALONG
    + """
    int* const tally = out_tally.data + (int64_t)(share) * cell_count;
    auto count = [&](int point, int x, int y, int z) {
        const int key = (z * grid.count_y + y) * grid.count_x + x;
        out_key.data[point] = key;
        ++tally[key];
    };
    bool even = true;
    for (int axis = 0; axis < 3; ++axis)
        even &= grid.first_cut[axis] == grid.last_cut[axis];
    int point = begin;
    if (even) {
        // Eight points in a row are three vectors of eight numbers, and number e of vector v is always of one axis.
        numbers origin[3], inverse[3], top[3];
        for (int v = 0; v < 3; ++v)
            for (int e = 0; e < 8; ++e) {
                const auto& cut = grid.cut.data[grid.first_cut[(8 * v + e) % 3]];
                origin[v][e] = cut[0], inverse[v][e] = cut[1], top[v][e] = cut[3] - 1.0;
            }
        alignas(32) int cell[24];
        for (; point + 8 <= end; point += 8) {
            const real* const from = (const real*)(points.data) + 3 * (int64_t)(point);
            for (int v = 0; v < 3; ++v) {
                const numbers at = __builtin_convertvector(*(const given*)(from + 8 * v), numbers);
                numbers along = (at - origin[v]) * inverse[v];
                along = along > 0.0 ? along : 0.0;
                along = along < top[v] ? along : top[v];
                *(integers*)(cell + 8 * v) = __builtin_convertvector(along, integers);
            }
            for (int e = 0; e < 8; ++e)
                count(point + e, cell[3 * e], cell[3 * e + 1], cell[3 * e + 2]);
        }
    }
    for (; point < end; ++point) {
        const auto& p = points.data[point];
        count(point, cell_along(0, p[0]), cell_along(1, p[1]), cell_along(2, p[2]));
    }
#endif
"""
)

PLACE = """
#if !defined(__CUDA_ARCH__)
    int* const next = next_place.data + (int64_t)(share) * cell_count;
    for (int point = begin; point < end; ++point)
        grid.index.data[next[key.data[point]]++] = point;
#endif
"""

GATHER = """
#if !defined(__CUDA_ARCH__)
    // Processors with a mended gather take ten times as long for one.
    #pragma clang loop vectorize(disable)
    for (int at = begin; at < end; ++at) {
        if (at + 16 < end)
            __builtin_prefetch(points.data + order.data[at + 16]);
        const auto& p = points.data[order.data[at]];
        grid.x.data[at] = p[0];
        grid.y.data[at] = p[1];
        grid.z.data[at] = p[2];
    }
#endif
"""


@wp.func_native(TALLY)
def tally(
    points: wp.array(dtype=Any),
    grid: CellGrid,
    share: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    cell_count: wp.int32,
    out_key: wp.array(dtype=wp.int32),
    out_tally: wp.array(dtype=wp.int32),
): ...


@wp.func_native(PLACE)
def place(
    key: wp.array(dtype=wp.int32),
    share: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    cell_count: wp.int32,
    next_place: wp.array(dtype=wp.int32),
    grid: CellGrid,
): ...


@wp.func_native(GATHER)
def gather(
    points: wp.array(dtype=Any),
    order: wp.array(dtype=wp.int32),
    begin: wp.int32,
    end: wp.int32,
    grid: CellGrid,
): ...


@wp.kernel
def tally_kernel(
    first: int,
    points: wp.array(dtype=Any),
    grid: CellGrid,
    share: wp.int32,
    cell_count: wp.int32,
    out_key: wp.array(dtype=wp.int32),
    out_tally: wp.array(dtype=wp.int32),
):
    """Cell of each point of a share of them, and how many of the share each cell has."""
    i = first + wp.tid()
    tally(points, grid, i, i * share, wp.min((i + 1) * share, points.shape[0]), cell_count, out_key, out_tally)


@wp.kernel
def place_kernel(
    first: int,
    key: wp.array(dtype=wp.int32),
    share: wp.int32,
    cell_count: wp.int32,
    next_place: wp.array(dtype=wp.int32),
    out_grid: CellGrid,
):
    """Which point stands where: those of a share; ``next_place`` is where its next point of each cell goes."""
    i = first + wp.tid()
    place(key, i, i * share, wp.min((i + 1) * share, key.shape[0]), cell_count, next_place, out_grid)


@wp.kernel
def gather_kernel(first: int, points: wp.array(dtype=Any), order: wp.array(dtype=wp.int32), out_grid: CellGrid):
    """Coordinates of GATHERED points in sorted order, one array for each axis."""
    begin = (first + wp.tid()) * GATHERED
    gather(points, order, begin, wp.min(begin + GATHERED, points.shape[0]), out_grid)


# A kernel is looked up here: to leave that to a launch takes longer than the launch.
ROWS = (wp.vec3d, wp.vec3f)
TALLY_OF = {r: wp.overload(tally_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
GATHER_OF = {r: wp.overload(gather_kernel, {"points": wp.array(dtype=r)}) for r in ROWS}
