"""C++ text that sets up rays for the wide tree, on the CPU: eight rays, one lane each.

One at a time, a ray's set-up is a chain of divisions and conversions that took a quarter of a random ray's time. Half
of those rays pass by the mesh's box altogether, which eight at once are told as quickly as one.
"""

from geokit.mesh._wide_raycast_kernels import BOX_MARGIN, ENDLESS, LEAST_COMPONENT, NEAR_START, PLANE_MARGIN

# Names that the text expects: tree, origins, directions, t_min, max_distance, out_bad; the vector types, mask_of,
# larger, smaller, greatest and least, Found and finish of the walk. PACKETS is replaced by what is done with rays that
# may hit something, group.waiting, before the walk of single rays takes them; that is left 0 where it is done with all.
# Directions shorter than SHORTEST are refused.
RAY_GROUPS = f"""
    // No wider: vectors of 512 bits lower the clock of some processors for a while: all walks took 5 to 7 % longer.
    typedef double d4 __attribute__((ext_vector_type(4), aligned(8)));
    typedef float f4 __attribute__((ext_vector_type(4), aligned(4)));
    typedef bool b4 __attribute__((ext_vector_type(4)));
    struct Group {{
        alignas(64) double best[8], enter[8], unit[8];
        alignas(32) float at[3][8], toward[3][8], reciprocal[3][8], to_near[3][8], to_far[3][8], last[8];
        int first;
        int apart;  // groups to come that are not walked together
        unsigned waiting;  // lanes of rays that may hit something and are not done
    }};
    Group group;
    group.waiting = 0;
    group.apart = 0;
    const double local = 1.0 / tree.scale;
    // The box of the mesh, and twice what a ray may be moved by.
    float lower[3], upper[3];
    for (int k = 0; k < 3; ++k) {{
        lower[k] = least(*(const v8*)(tree.boxes.data + 8 * k)) - 2.f * {BOX_MARGIN}f;
        upper[k] = greatest(*(const v8*)(tree.boxes.data + 8 * k + 24)) + 2.f * {BOX_MARGIN}f;
    }}
    // Four rows of x, y, z as three vectors.
    auto columns = [](const double* row, d4* column) {{
        const d4 a = *(const d4*)row, b = *(const d4*)(row + 4), c = *(const d4*)(row + 8);
        column[0] = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 6), c, 0, 1, 2, 5);
        column[1] = __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 7), c, 0, 1, 2, 6);
        column[2] = __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 5, 5), c, 0, 1, 4, 7);
    }};
    auto mask_of_four = [](auto lanes) {{
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(lanes, b4)) & 15u;
    }};
    auto joined = [](const f4* half) {{ return __builtin_shufflevector(half[0], half[1], 0, 1, 2, 3, 4, 5, 6, 7); }};
    // The next rays, up to eight, as from + s * along in local units, the largest component of along being 1:
    // s = unit * t.
    auto set_up = [&](int first, int count) {{
        const double* place = (const double*)(origins.data + first);
        const double* heading = (const double*)(directions.data + first);
        double rows[2][24];
        if (count < 8) {{
            for (int i = 0; i < 24; ++i) {{
                const int j = i < 3 * count ? i : i % 3;
                rows[0][i] = place[j];
                rows[1][i] = heading[j];
            }}
            place = rows[0];
            heading = rows[1];
        }}
        d4 reach[2] = {{max_distance, max_distance}};
        if (max_distance < (double)INFINITY) {{
            for (int i = 0; i < count; ++i) reach[i >> 2][i & 3] /= wp::length(directions.data[first + i]);
        }}
        unsigned left = 0xffu >> (8 - count);
        f4 toward[3][2], reciprocal[3][2], start[3][2], length[2];
        for (int h = 0; h < 2; ++h) {{
            d4 from[3], along[3], largest = 0.0, far = 0.0, none = 0.0;
            columns(place + 12 * h, from);
            columns(heading + 12 * h, along);
            for (int k = 0; k < 3; ++k) {{
                // A number minus itself is zero, unless it is infinite or none.
                none += (from[k] - from[k]) + (along[k] - along[k]);
                largest = larger(largest, __builtin_elementwise_abs(along[k]));
                from[k] = (from[k] - tree.origin[k]) * local;
                far = larger(far, __builtin_elementwise_abs(from[k]));
            }}
            const unsigned good = mask_of_four((largest >= SHORTEST) & (none == 0.0));
            if (good != 15u) {{
                // The host refuses the whole batch and says which row is to blame.
                out_bad.data[0] = 1;
                left &= good << 4 * h | 15u << 4 * (1 - h);
            }}
            const d4 shrink = 1.0 / largest, unit = largest * local;
            for (int k = 0; k < 3; ++k) {{
                along[k] *= shrink;
                const f4 way = __builtin_convertvector(along[k], f4), shortest = {LEAST_COMPONENT}f;
                toward[k][h] = way;
                reciprocal[k][h] =
                    __builtin_elementwise_copysign(1.f / larger(__builtin_elementwise_abs(way), shortest), way);
            }}
            d4 enter = t_min * unit;
            const auto outside = far > {NEAR_START};
            if (mask_of_four(outside)) {{
                // A little early and late: these reciprocals have the digits of float32, and the cube has a margin.
                const d4 edge = 1.0 + 1e-5 + 1e-6 * far;
                d4 in = enter, out = (double)INFINITY;
                for (int k = 0; k < 3; ++k) {{
                    const d4 rate = __builtin_convertvector(reciprocal[k][h], d4);
                    const d4 t0 = (-edge - from[k]) * rate, t1 = (edge - from[k]) * rate;
                    in = larger(in, smaller(t0, t1));
                    out = smaller(out, larger(t0, t1));
                }}
                left &= mask_of_four(~outside | (in <= out)) << 4 * h | 15u << 4 * (1 - h);
                enter = outside ? in : enter;
            }}
            *(d4*)(group.best + 4 * h) = reach[h];
            *(d4*)(group.enter + 4 * h) = enter;
            *(d4*)(group.unit + 4 * h) = unit;
            length[h] = __builtin_convertvector(reach[h] * unit - enter, f4);
            for (int k = 0; k < 3; ++k) start[k][h] = __builtin_convertvector(from[k] + enter * along[k], f4);
        }}
        // As length_of, for all.
        const v8 last = smaller(joined(length) * 1.000001f + {PLANE_MARGIN}f, (v8){ENDLESS}f);
        *(v8*)group.last = last;
        v8 in = 0.f, out = last;
        for (int k = 0; k < 3; ++k) {{
            const v8 at = joined(start[k]), rate = joined(reciprocal[k]);
            const v8 aside = __builtin_elementwise_copysign((v8){BOX_MARGIN}f, rate);
            *(v8*)group.at[k] = at;
            *(v8*)group.toward[k] = joined(toward[k]);
            *(v8*)group.reciprocal[k] = rate;
            *(v8*)group.to_near[k] = -(at + aside) * rate;
            *(v8*)group.to_far[k] = -(at - aside) * rate;
            const v8 t0 = (lower[k] - at) * rate, t1 = (upper[k] - at) * rate;
            in = larger(in, smaller(t0, t1));
            out = smaller(out, larger(t0, t1));
        }}
        group.first = first;
        group.waiting = left & mask_of(in <= out);
    }};
    // Out of line: the walk of single rays needs its registers.
    auto next_group = [&](int first, int count) OUT_OF_LINE {{
        set_up(first, count);
        for (unsigned passed = ~group.waiting & (0xffu >> (8 - count)); passed; passed &= passed - 1) {{
            Found r;
            r.id = first + __builtin_ctz(passed);
            r.winner = -1;
            r.count = 0;
            finish(r);
        }}
        PACKETS
    }};
"""
