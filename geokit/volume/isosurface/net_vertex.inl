// The vertices of one cell: for each sheet, the mean of the crossings of its edges.
//
// Expects sheet_cases.inl, linear, offset, END; on a CPU also core/simd.inl. Defines place.
//
// SIMD and scalar sums run in the same order, so that a CPU and a GPU give the same bits.

constexpr float least_place = (float)END, most_place = 1.f - least_place;
auto clamped = [](float t) -> float {
    // The comparisons turn NaN into a number.
    const float end = t > least_place ? t : least_place;
    return end < most_place ? end : most_place;
};
auto to_world = [&](const int* at, const float* local, wp::vec_t<3, double>& out) {
    double index[3];
    for (int k = 0; k < 3; ++k) index[k] = (double)at[k] + (double)local[k];
    for (int row = 0; row < 3; ++row) {
        out[row] = linear.data[row][0] * index[0] + linear.data[row][1] * index[1] + linear.data[row][2] * index[2]
                   + offset[row];
    }
};
// Places the vertices of a cell whose corners have the values f relative to the isovalue. `sums` is a word of
// sum_table: sums of the crossed edges' constant coordinates x, y, z and their number, four bits each, then the edges.
auto place = [&](unsigned word, unsigned sums, const float* f, const int* at, wp::vec_t<3, double>* out) {
    #ifndef __CUDA_ARCH__
    if (loop_count(word) == 1) {
        const v8 all = *(const v8*)f;
        const v16 low = __builtin_shufflevector(all, all, 0, 1, 2, 3, 0, 1, 4, 5, 0, 2, 4, 6, 0, 0, 0, 0);
        const v16 high = __builtin_shufflevector(all, all, 4, 5, 6, 7, 2, 3, 6, 7, 1, 3, 5, 7, 0, 0, 0, 0);
        const i16 lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
        const v16 t = low / (low - high);
        const v16 least = least_place, most = most_place, none = 0.f;
        const v16 end = t > least ? t : least;
        const v16 inner = end < most ? end : most;
        const v16 one = ((i16)(int)(sums >> 16) >> lane & 1) != 0 ? inner : none;
        const v16 two = one + __builtin_shufflevector(one, one, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
        const float number = (float)(sums >> 12 & 15u);
        const float local[3] = {((float)(sums & 15u) + (two[0] + two[2])) / number,
                                ((float)(sums >> 4 & 15u) + (two[4] + two[6])) / number,
                                ((float)(sums >> 8 & 15u) + (two[8] + two[10])) / number};
        to_world(at, local, out[0]);
        return;
    }
    #endif
    for (int loop = 0; loop < loop_count(word); ++loop) {
        int whole[3] = {}, number = 0;
        float part[3];
        for (int axis = 0; axis < 3; ++axis) {
            float one[4];
            for (int side = 0; side < 4; ++side) {
                const int edge = 4 * axis + side;
                const int n = (side >> 1) * (axis == 0 ? 2 : 4) + (side & 1) * (axis == 2 ? 2 : 1);
                const bool is_in = (sums >> 16 >> edge & 1u) && (int)(word >> 2 * edge & 3u) == loop;
                one[side] = is_in ? clamped(f[n] / (f[n] - f[n + (4 >> axis)])) : 0.f;
                number += is_in;
                for (int k = 0; k < 3; ++k) whole[k] += is_in ? n >> (2 - k) & 1 : 0;
            }
            part[axis] = (one[0] + one[1]) + (one[2] + one[3]);
        }
        float local[3];
        for (int k = 0; k < 3; ++k) local[k] = ((float)whole[k] + part[k]) / (float)number;
        to_world(at, local, out[loop]);
    }
};
