// Set-up of rays for the CPU tree: eight rays, one lane each.
//
// For a single ray the set-up is a chain of divisions and conversions that took a quarter of a random ray's time. Half
// of those rays miss the mesh's box altogether, which costs no more to detect for eight rays than for one. The numbers
// that the traversal reads of a ray are transposed into 16 floats and 8 row numbers: copying them one by one took a
// tenth of a random ray's time. Doubles are processed in fours: vectors of 512 bits lower the clock of some processors
// for a while, and all traversals took 5 to 7 % longer.
//
// Expects core/simd.inl and exact_arithmetic.inl (point, OUT_OF_LINE); tree, origins, directions, t_min, max_distance,
// out_bad; finish(r), called for rays that miss the box; AHEAD, SHORTEST_DIRECTION, NEAR_START, BOX_MARGIN,
// PLANE_MARGIN, ENDLESS, LEAST_COMPONENT. Defines larger, smaller, greatest, least, Found, the offsets of a ray's
// numbers, group, and next_group(first, count), which fills group. Also defines local, lower, upper, columns, joined,
// transpose, set_up.
#if !defined(__CUDA_ARCH__)
// One instruction each; the built-in functions take more, because they must prefer a number to NaN.
auto larger = [](auto a, auto b) { return a > b ? a : b; };
auto smaller = [](auto a, auto b) { return a < b ? a : b; };
auto greatest = [&](v8 a) {
    a = larger(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
    a = larger(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    a = larger(a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
    return a[0];
};
auto least = [&](v8 a) { return -greatest(-a); };
// The result of a ray so far.
struct Found {
    double best, weight_b, weight_c;
    int id, winner, count;
};
// Numbers of a ray in local units: reciprocals of its direction; those times its start, moved by BOX_MARGIN against
// near planes and far ones; its start and its slopes, along the axes of leaves; 1 or -1 along their z; its length. Then
// row numbers: the near and far rows of a node's boxes; the axis that is the z of leaves.
enum { RATE = 0, TO_NEAR = 3, TO_FAR = 6, AT = 9, SHEAR = 12, FORWARD = 14, LAST = 15 };
enum { NEAR_ROW = 0, FAR_ROW = 3, AXIS = 6 };
struct Group {
    alignas(64) double best[8], enter[8], unit[8];
    alignas(32) float field[8][16];
    alignas(32) int row[8][8];
    int first;
    unsigned waiting;  // lanes of rays that may hit something and are not done
};
Group group;
group.waiting = 0;
const double local = 1.0 / tree.scale;
// The box of the mesh, and twice the rounding error of a ray.
float lower[3], upper[3];
for (int k = 0; k < 3; ++k) {
    lower[k] = least(*(const v8*)(tree.boxes.data + 8 * k)) - 2.f * BOX_MARGIN;
    upper[k] = greatest(*(const v8*)(tree.boxes.data + 8 * k + 24)) + 2.f * BOX_MARGIN;
}
// Four rows of x, y, z as three vectors.
auto columns = [](const double* row, d4* column) {
    const d4 a = *(const d4*)row, b = *(const d4*)(row + 4), c = *(const d4*)(row + 8);
    column[0] = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 6), c, 0, 1, 2, 5);
    column[1] = __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 7), c, 0, 1, 2, 6);
    column[2] = __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 5, 5), c, 0, 1, 4, 7);
};
auto joined = [](const v4* half) { return __builtin_shufflevector(half[0], half[1], 0, 1, 2, 3, 4, 5, 6, 7); };
// Eight vectors into eight rows, `stride` numbers apart.
auto transpose = [](const v8* from, float* to, int stride) {
    v8 pair[8], four[8];
    for (int i = 0; i < 4; ++i) {
        pair[2 * i] = __builtin_shufflevector(from[2 * i], from[2 * i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        pair[2 * i + 1] = __builtin_shufflevector(from[2 * i], from[2 * i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
        for (int j = 0; j < 2; ++j) {
            const v8 a = pair[i + j], b = pair[i + j + 2];
            four[i + 2 * j] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
            four[i + 2 * j + 1] = __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
        }
    for (int i = 0; i < 4; ++i) {
        *(v8*)(to + i * stride) = __builtin_shufflevector(four[i], four[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        *(v8*)(to + (i + 4) * stride) = __builtin_shufflevector(four[i], four[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
};
// The next rays, up to eight, as from + s * along in local units with the largest component of along being 1:
// s = unit * t.
auto set_up = [&](int first, int count) {
    // The result only selects candidates: fused products round less, and are faster.
    #pragma clang fp contract(fast)
    const double* place = (const double*)(origins.data + first);
    const double* heading = (const double*)(directions.data + first);
    for (int i = 0; i < 3; ++i) {
        __builtin_prefetch((const char*)(place + 3 * AHEAD) + 64 * i);
        __builtin_prefetch((const char*)(heading + 3 * AHEAD) + 64 * i);
    }
    double rows[2][24];
    if (count < 8) {
        for (int i = 0; i < 24; ++i) {
            const int j = i < 3 * count ? i : i % 3;
            rows[0][i] = place[j];
            rows[1][i] = heading[j];
        }
        place = rows[0];
        heading = rows[1];
    }
    d4 reach[2] = {max_distance, max_distance};
    if (max_distance < (double)INFINITY) {
        for (int i = 0; i < count; ++i) reach[i >> 2][i & 3] /= wp::length(directions.data[first + i]);
    }
    unsigned left = 0xffu >> (8 - count);
    v4 toward[3][2], reciprocal[3][2], start[3][2], length[2];
    // Unrolled, so that the results stay in registers: loading eight floats as one vector stalls if they were stored as
    // two halves.
    #pragma unroll
    for (int h = 0; h < 2; ++h) {
        d4 from[3], along[3], largest = 0.0, far = 0.0, none = 0.0;
        columns(place + 12 * h, from);
        columns(heading + 12 * h, along);
        for (int k = 0; k < 3; ++k) {
            // x - x is zero, unless x is infinite or NaN.
            none += (from[k] - from[k]) + (along[k] - along[k]);
            largest = larger(largest, __builtin_elementwise_abs(along[k]));
            from[k] = (from[k] - tree.origin[k]) * local;
            far = larger(far, __builtin_elementwise_abs(from[k]));
        }
        const unsigned good = mask_of_four((largest >= SHORTEST_DIRECTION) & (none == 0.0));
        if (good != 15u) {
            // The host rejects the whole batch and names the row.
            out_bad.data[0] = 1;
            left &= good << 4 * h | 15u << 4 * (1 - h);
        }
        const d4 shrink = 1.0 / largest, unit = largest * local;
        for (int k = 0; k < 3; ++k) {
            along[k] *= shrink;
            const v4 way = __builtin_convertvector(along[k], v4), shortest = LEAST_COMPONENT;
            toward[k][h] = way;
            reciprocal[k][h] =
                __builtin_elementwise_copysign(1.f / larger(__builtin_elementwise_abs(way), shortest), way);
        }
        d4 enter = t_min * unit;
        const auto outside = far > NEAR_START;
        if (mask_of_four(outside)) {
            // Slightly early and late: these reciprocals have the precision of float32, and the cube has a margin.
            const d4 edge = 1.0 + 1e-5 + 1e-6 * far;
            d4 in = enter, out = (double)INFINITY;
            for (int k = 0; k < 3; ++k) {
                const d4 rate = __builtin_convertvector(reciprocal[k][h], d4);
                const d4 t0 = (-edge - from[k]) * rate, t1 = (edge - from[k]) * rate;
                in = larger(in, smaller(t0, t1));
                out = smaller(out, larger(t0, t1));
            }
            left &= mask_of_four(~outside | (in <= out)) << 4 * h | 15u << 4 * (1 - h);
            enter = outside ? in : enter;
        }
        *(d4*)(group.best + 4 * h) = reach[h];
        *(d4*)(group.enter + 4 * h) = enter;
        *(d4*)(group.unit + 4 * h) = unit;
        length[h] = __builtin_convertvector(reach[h] * unit - enter, v4);
        for (int k = 0; k < 3; ++k) start[k][h] = __builtin_convertvector(from[k] + enter * along[k], v4);
    }
    // As length_of in raycast_bvh8_cpu.inl, for eight rays.
    const v8 last = smaller(joined(length) * 1.000001f + PLANE_MARGIN, (v8)ENDLESS);
    v8 field[16], in = 0.f, out = last, at[3], way[3];
    i8 back[3];
    for (int k = 0; k < 3; ++k) {
        at[k] = joined(start[k]);
        way[k] = joined(toward[k]);
        const v8 rate = joined(reciprocal[k]);
        const v8 aside = __builtin_elementwise_copysign((v8)BOX_MARGIN, rate);
        field[RATE + k] = rate;
        field[TO_NEAR + k] = -(at[k] + aside) * rate;
        field[TO_FAR + k] = -(at[k] - aside) * rate;
        back[k] = ((i8)rate >> 31) & 24;
        const v8 t0 = (lower[k] - at[k]) * rate, t1 = (upper[k] - at[k]) * rate;
        in = larger(in, smaller(t0, t1));
        out = smaller(out, larger(t0, t1));
    }
    group.first = first;
    group.waiting = left & mask_of(in <= out);
    if (!group.waiting) return;
    // The axis of the largest component, 1 or -1, is the z of leaves.
    const auto z_is_x = __builtin_elementwise_abs(way[0]) == 1.f;
    const auto z_is_y = ~z_is_x & (__builtin_elementwise_abs(way[1]) == 1.f);
    const auto z_is_z = ~(z_is_x | z_is_y);
    const v8 forward = z_is_x ? way[0] : z_is_y ? way[1] : way[2];
    field[AT] = z_is_x ? at[1] : at[0];
    field[AT + 1] = z_is_z ? at[1] : at[2];
    field[AT + 2] = z_is_x ? at[0] : z_is_y ? at[1] : at[2];
    field[SHEAR] = (z_is_x ? way[1] : way[0]) * forward;
    field[SHEAR + 1] = (z_is_z ? way[1] : way[2]) * forward;
    field[FORWARD] = forward;
    field[LAST] = last;
    transpose(field, group.field[0], 16);
    transpose(field + 8, group.field[0] + 8, 16);
    const i8 axis = (z_is_y & 1) | (z_is_z & 2);
    const v8 row[8] = {(v8)back[0],        (v8)(back[1] + 8),  (v8)(back[2] + 16), (v8)(24 - back[0]),
                       (v8)(32 - back[1]), (v8)(40 - back[2]), (v8)axis,           (v8)axis};
    transpose(row, (float*)group.row[0], 8);
};
// Out of line, because the traversal needs the registers.
auto next_group = [&](int first, int count) OUT_OF_LINE {
    set_up(first, count);
    for (unsigned passed = ~group.waiting & (0xffu >> (8 - count)); passed; passed &= passed - 1) {
        Found r;
        r.id = first + __builtin_ctz(passed);
        r.winner = -1;
        r.count = 0;
        finish(r);
    }
};
#endif
