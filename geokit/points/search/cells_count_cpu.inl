// Counting sort, first step: the cell of each point of a share, and the number of the share's points in each cell.
//
// Expects core/simd.inl, cells_of_group_cpu.inl, cell_along_cpu.inl, points, grid, share, begin, end, cell_count, out_key, out_counts.

#if !defined(__CUDA_ARCH__)
typedef decltype(points.data[0][0] + points.data[0][0]) real;
typedef real given __attribute__((ext_vector_type(8), aligned(4)));

int* const counts = out_counts.data + (int64_t)(share)*cell_count;
auto count = [&](int point, int x, int y, int z) {
    const int key = (int)cells.base + (z * cells.count_y + y) * cells.count_x + x;
    out_key.data[point] = key;
    ++counts[key];
};
const bool grouped = grid.groups.shape[0] > 0;
bool even = !grouped;
for (int axis = 0; axis < 3; ++axis) even &= grid.first_cut[axis] == grid.last_cut[axis];
int point = begin;
if (even) {
    // Eight consecutive points are three vectors of eight numbers, and lane e of vector v always belongs to one axis.
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
        for (int e = 0; e < 8; ++e) count(point + e, cell[3 * e], cell[3 * e + 1], cell[3 * e + 2]);
    }
}
for (; point < end; ++point) {
    const auto& p = points.data[point];
    if (grouped) enter(grid.group.data[point]);
    count(point, cell_along(0, p[0]), cell_along(1, p[1]), cell_along(2, p[2]));
}
#endif
