// Bounding boxes and counting sort of points by cell on a CPU.
#include "core/simd.inl"
#include "points/search/cell_along.inl"

// First step: the cell of each point of a share, and the number of the share's points in each cell.
static constexpr auto count = [](int item, const auto& points, const auto& grid, int share, int cell_count,
                                 wp::array_t<int>& out_key, wp::array_t<int>& out_counts) {
    const int begin = item * share, end = wp::min(begin + share, points.shape[0]);
    typedef decltype(points.data[0][0] + points.data[0][0]) real;
    typedef real given __attribute__((ext_vector_type(8), aligned(4)));
    auto cells = grid;
    int entered = -1;
    int* const counts = out_counts.data + (int64_t)(item)*cell_count;
    auto add = [&](int point, int x, int y, int z) {
        const int key = (int)cells.base + (z * cells.count_y + y) * cells.count_x + x;
        out_key.data[point] = key;
        ++counts[key];
    };
    const bool grouped = grid.groups.shape[0] > 0;
    bool even = !grouped;
    for (int axis = 0; axis < 3; ++axis) even &= grid.first_cut[axis] == grid.last_cut[axis];
    int point = begin;
    if (even) {
        // Eight points are three vectors of eight numbers, and lane e of vector v always belongs to one axis.
        alignas(64) d8 origin[3], inverse[3], top[3];
        for (int v = 0; v < 3; ++v)
            for (int e = 0; e < 8; ++e) {
                const auto& cut = grid.cut.data[grid.first_cut[(8 * v + e) % 3]];
                origin[v][e] = cut[0], inverse[v][e] = cut[1], top[v][e] = cut[3] - 1.0;
            }
        alignas(32) int cell[24];
        for (; point + 8 <= end; point += 8) {
            const real* const from = (const real*)(points.data) + 3 * (int64_t)(point);
            for (int v = 0; v < 3; ++v) {
                const d8 at = __builtin_convertvector(*(const given*)(from + 8 * v), d8);
                d8 along = (at - origin[v]) * inverse[v];
                along = along > 0.0 ? along : 0.0;
                along = along < top[v] ? along : top[v];
                *(i8*)(cell + 8 * v) = __builtin_convertvector(along, i8);
            }
            for (int e = 0; e < 8; ++e) add(point + e, cell[3 * e], cell[3 * e + 1], cell[3 * e + 2]);
        }
    }
    for (; point < end; ++point) {
        const auto& p = points.data[point];
        if (grouped) enter(grid, grid.group.data[point], cells, entered);
        add(point, cell_along(cells, 0, p[0]), cell_along(cells, 1, p[1]), cell_along(cells, 2, p[2]));
    }
};

// Last step: each point of a share goes to the next free position of its cell. Only four bytes a point are scattered.
static constexpr auto place = [](int item, const wp::array_t<int>& key, int share, int cell_count,
                                 const wp::array_t<int>& next_place, auto& grid) {
    const int begin = item * share, end = wp::min(begin + share, key.shape[0]);
    int* const next = next_place.data + (int64_t)(item)*cell_count;
    for (int point = begin; point < end; ++point) grid.index.data[next[key.data[point]]++] = point;
};

// Gathers the coordinates of points in sorted order, one array for each axis.
static constexpr auto gather = [](int item, const auto& points, const wp::array_t<int>& order, auto& grid) {
    const int begin = item * GATHERED, end = wp::min(begin + GATHERED, points.shape[0]);
    // Scalar loads: on processors with the microcode mitigation for gather instructions, a gather takes ten times as
    // long.
    #pragma clang loop vectorize(disable)
    for (int at = begin; at < end; ++at) {
        if (at + 16 < end) __builtin_prefetch(points.data + order.data[at + 16]);
        const auto& p = points.data[order.data[at]];
        grid.x.data[at] = p[0];
        grid.y.data[at] = p[1];
        grid.z.data[at] = p[2];
    }
};

// Bounding box of the points of a share; not finite if one of the points is not.
//
// Eight consecutive points are three vectors of eight numbers, and lane e of vector v always belongs to the same axis.
// A sum of differences keeps a non-finite value; comparisons may skip it.
static constexpr auto box_of = [](int share, const auto& points, wp::array_t<wp::vec3d>& out_lower,
                                  wp::array_t<wp::vec3d>& out_upper) {
    const int begin = share * SHARE, end = wp::min(begin + SHARE, points.shape[0]);
    typedef decltype(points.data[0][0] + points.data[0][0]) real;
    typedef real numbers __attribute__((ext_vector_type(8), aligned(4)));
    const real* const given = (const real*)(points.data) + 3 * (int64_t)(begin);
    const int count = 3 * (end - begin);
    numbers low[3], high[3], rest[3];
    for (int v = 0; v < 3; ++v) {
        for (int e = 0; e < 8; ++e) low[v][e] = given[(8 * v + e) % 3];
        high[v] = low[v];
        rest[v] = low[v] - low[v];
    }
    int at = 0;
    for (; at + 24 <= count; at += 24)
        for (int v = 0; v < 3; ++v) {
            const numbers p = *(const numbers*)(given + at + 8 * v);
            low[v] = p < low[v] ? p : low[v];
            high[v] = p > high[v] ? p : high[v];
            rest[v] += p - p;
        }
    for (; at < count; ++at) {
        const int v = at % 24 / 8, e = at % 8;
        const real p = given[at];
        low[v][e] = p < low[v][e] ? p : low[v][e];
        high[v][e] = p > high[v][e] ? p : high[v][e];
        rest[v][e] += p - p;
    }
    for (int axis = 0; axis < 3; ++axis) {
        double lower = low[0][axis], upper = high[0][axis], total = 0.0;
        for (int k = axis; k < 24; k += 3) {
            lower = low[k / 8][k % 8] < lower ? low[k / 8][k % 8] : lower;
            upper = high[k / 8][k % 8] > upper ? high[k / 8][k % 8] : upper;
            total += rest[k / 8][k % 8];
        }
        out_lower.data[share][axis] = lower + total;
        out_upper.data[share][axis] = upper + total;
    }
};
