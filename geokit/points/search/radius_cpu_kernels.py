"""Radius search on a CPU: queries of one cell share the candidates around it.

The candidates of a cell, some dozen ranges of sorted points, are laid end to end in a buffer that stays in the first
cache; every query of the cell then reads it from front to back, sixteen points at a time, without a branch that
depends on the data. Float32, seen from the cell, decides wherever its error cannot matter, float64 where it can.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

from geokit.points.search.cells_kernels import CellGrid
from geokit.points.search.neighbors_kernels import Queries
from geokit.points.search.radius_cuda_kernels import SORT_BY_INDEX
from geokit.points.search.radius_runs_cpu_kernels import NUMBERS, RUNS, SHARE

# Contracted multiply-adds would round the squared distance once instead of five times.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Sixteen entries of the buffer of which some are kept: `inside` has a bit for each.
KEEP = """
#if !defined(__CUDA_ARCH__)
    typedef int stored __attribute__((__vector_size__(64)));
    auto keep = [&](int* to, int at, unsigned inside) -> int {
#if defined(__AVX512F__)
        __builtin_ia32_compressstoresi512_mask((stored*)to, *(const stored*)(place + at), inside);
        return __builtin_popcount(inside);
#else
        int kept = 0;
        for (; inside; inside &= inside - 1)
            to[kept++] = place[at + __builtin_ctz(inside)];
        return kept;
#endif
    };
#endif
"""

# What is found is noted for the fill, where there is room for notes: for each query how many there are and where they
# stand among the sorted points. Before them stands 1 if those of all queries of the share are there.
COUNT = (
    "int run = first_query;"
    + RUNS
    + KEEP
    + """
#if !defined(__CUDA_ARCH__)
    const int64_t begin = (int64_t)(share) * note_size;
    bool whole = begin < out_note.shape[0];
    int *to = out_note.data + begin + 1, next = first_query;
    const int* const end = to - 1 + note_size;
    for (int k = first_query; k < last_query; ++k)
        out_count.data[queries.index.data[k]] = -self_count;
    // Queries come in turn. Those that nothing is near to are left out; of a crowd all come again, which is not noted.
    each_run([&](int k, int length) {
        whole = whole && k >= next && to + (k - next) + 1 + length <= end;
        int inside = 0;
        if (whole) {
            for (; next < k; ++next)
                *to++ = 0;
            int* const found = to + 1;
            for (int at = 0; at < length; at += 16)
                inside += keep(found + inside, at, within(k, at));
            *to = inside;
            to = found + inside;
            ++next;
        } else
            for (int at = 0; at < length; at += 16)
                inside += __builtin_popcount(within(k, at));
        out_count.data[queries.index.data[k]] += inside;
    });
    if (begin < out_note.shape[0]) {
        whole = whole && to + (last_query - next) <= end;
        for (; whole && next < last_query; ++next)
            *to++ = 0;
        out_note.data[begin] = whole;
    }
#endif
"""
)

FILL = (
    "int run = first_query;"
    + RUNS
    + KEEP
    + """
#if !defined(__CUDA_ARCH__)
    typedef double doubles __attribute__((ext_vector_type(8), aligned(8)));
    // Neighbours found in one filling of the buffer: where they stand among the sorted points, whose they are, how far.
    alignas(64) int found[room + 32], key[room + 32], rank[RANKED + 32];
    alignas(64) double distance[room + 32];
    int written[SHARE_SIZE];
    // Rows lie in the caller's order, all over the memory: what is needed soon is asked for early.
    for (int k = first_query; k < last_query; ++k) {
        written[k - first_query] = 0;
        __builtin_prefetch(offset.data + queries.index.data[k]);
    }
    auto put = [&](int k, const int* found, int count) {
        const int row = queries.index.data[k], without = row + own;
        if (k + AHEAD < last_query) {
            // All lines of a row: it seldom begins with one.
            const int next = queries.index.data[k + AHEAD];
            const int64_t row_begin = offset.data[next], length = offset.data[next + 1] - row_begin;
            const int64_t most = length < PREFETCHED ? length : PREFETCHED;
            auto ask = [&](const auto* first) {
                const char* const end = (const char*)(first + most) + 63;
                for (const char* line = (const char*)(first); line < end; line += 64)
                    __builtin_prefetch(line, 1);
            };
            ask(out_index.data + row_begin);
            ask(out_distance.data + row_begin);
        }
        const double x = queries.x.data[k], y = queries.y.data[k], z = queries.z.data[k];
        // The compiler's own vectors would gather here and scatter below. Processors with a mended gather take ten
        // times as long for the one, and none is quicker with the other.
        #pragma clang loop vectorize(disable)
        for (int i = 0; i < count; ++i) {
            const int p = found[i];
            const double dx = grid.x.data[p] - x, dy = grid.y.data[p] - y, dz = grid.z.data[p] - z;
            key[i] = grid.index.data[p];
            distance[i] = (dx * dx + dy * dy) + dz * dz;
        }
        int kept = count;
        if (own >= 0) {
            kept = 0;
            for (int i = 0; i < count; ++i)
                if (key[i] != without) {
                    key[kept] = key[i];
                    distance[kept++] = distance[i];
                }
        }
        for (int i = 0; i < kept; i += 8)
            *(doubles*)(distance + i) = __builtin_elementwise_sqrt(*(const doubles*)(distance + i));
        int& so_far = written[k - first_query];
        int* const keys = out_index.data + offset.data[row];
        auto* const values = out_distance.data + offset.data[row];
{PUT}        so_far += kept;
    };
    const int64_t begin = (int64_t)(share) * note_size;
    const int* at = note.data + begin;
    if (begin < note.shape[0] && *at++)
        for (int k = first_query; k < last_query; ++k) {
            const int count = *at++;
            if (count)
                put(k, at, count);
            at += count;
        }
    else
        each_run([&](int k, int length) {
            int count = 0;
            for (int at = 0; at < length; at += 16)
                count += keep(found + count, at, within(k, at));
            put(k, found, count);
        });
#endif
"""
)

# A row is put in order of index when it is written, or left in the order of the cells.
BY_INDEX = """
        auto sort_row = [](int* key, auto* value, int count) {SORT};
        if (so_far == 0 && kept <= RANKED) {
            // A short row is sorted by counting for each entry how many are smaller, sixteen entries at a time: no
            // branch depends on the data.
            *(places*)(key + kept) = (places)(0x7fffffff);
            for (int at = 0; at < kept; at += 32) {
                const places low = *(const places*)(key + at), high = *(const places*)(key + at + 16);
                places low_rank = 0, high_rank = 0;
                for (int j = 0; j < kept; ++j) {
                    low_rank -= low > (places)(key[j]);
                    high_rank -= high > (places)(key[j]);
                }
                *(places*)(rank + at) = low_rank;
                *(places*)(rank + at + 16) = high_rank;
            }
            #pragma clang loop vectorize(disable)
            for (int i = 0; i < kept; ++i) {
                keys[rank[i]] = key[i];
                values[rank[i]] = distance[i];
            }
        } else {
            for (int i = 0; i < kept; ++i) {
                keys[so_far + i] = key[i];
                values[so_far + i] = distance[i];
            }
            sort_row(keys, values, so_far + kept);
        }
"""

AS_FOUND = """
        for (int i = 0; i < kept; ++i) {
            keys[so_far + i] = key[i];
            values[so_far + i] = distance[i];
        }
"""


def _numbered(text: str) -> str:
    for name, number in NUMBERS.items():
        text = text.replace(name, repr(number))
    return text


@wp.func_native(_numbered(COUNT))
def count_share(
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    self_count: wp.int32,
    note_size: wp.int32,
    share: wp.int32,
    first_query: wp.int32,
    last_query: wp.int32,
    out_count: wp.array(dtype=wp.int32),
    out_note: wp.array(dtype=wp.int32),
): ...


@wp.func_native(_numbered(FILL.replace("{PUT}", BY_INDEX.replace("{SORT}", "{" + SORT_BY_INDEX + "}"))))
def fill_by_index(
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    note: wp.array(dtype=wp.int32),
    note_size: wp.int32,
    share: wp.int32,
    first_query: wp.int32,
    last_query: wp.int32,
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
): ...


@wp.func_native(_numbered(FILL.replace("{PUT}", AS_FOUND)))
def fill_as_found(
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    note: wp.array(dtype=wp.int32),
    note_size: wp.int32,
    share: wp.int32,
    first_query: wp.int32,
    last_query: wp.int32,
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
): ...


@wp.kernel
def count_share_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    self_count: wp.int32,
    note_size: wp.int32,
    out_count: wp.array(dtype=wp.int32),
    out_note: wp.array(dtype=wp.int32),
):
    """Number of neighbours of SHARE queries each, less ``self_count``.

    Each share notes what it finds in ``note_size`` numbers of ``out_note``, as long as there are some.
    """
    share = first + wp.tid()
    begin = share * SHARE
    end = wp.min(begin + SHARE, queries.index.shape[0])
    count_share(queries, grid, radius, self_count, note_size, share, begin, end, out_count, out_note)


@wp.kernel
def fill_by_index_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    note_size: wp.int32,
    note: wp.array(dtype=wp.int32),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
):
    """Neighbours of SHARE queries, each from its offset on, by ascending index."""
    share = first + wp.tid()
    begin = share * SHARE
    end = wp.min(begin + SHARE, queries.index.shape[0])
    fill_by_index(queries, grid, radius, own, offset, note, note_size, share, begin, end, out_index, out_distance)


@wp.kernel
def fill_as_found_kernel(
    first: int,
    queries: Queries,
    grid: CellGrid,
    radius: wp.array(dtype=wp.float64),
    own: wp.int32,
    offset: wp.array(dtype=wp.int64),
    note_size: wp.int32,
    note: wp.array(dtype=wp.int32),
    out_index: wp.array(dtype=wp.int32),
    out_distance: wp.array(dtype=Any),
):
    """Neighbours of SHARE queries, each from its offset on, in the order of the cells."""
    share = first + wp.tid()
    begin = share * SHARE
    end = wp.min(begin + SHARE, queries.index.shape[0])
    fill_as_found(queries, grid, radius, own, offset, note, note_size, share, begin, end, out_index, out_distance)


# By order of the rows, and the type of distances: in float32 there is a third less to write.
FILL_KERNELS = {
    (order, real): wp.overload(kernel, {"out_distance": wp.array(dtype=real)})
    for order, kernel in (("index", fill_by_index_kernel), ("any", fill_as_found_kernel))
    for real in (wp.float64, wp.float32)
}
