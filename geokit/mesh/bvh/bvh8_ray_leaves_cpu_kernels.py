"""C++ text of leaves as rays read them, on the CPU: eight triangles in three cache lines, corners in 16 bits an axis.

A ray waits for the lines of a leaf more than for anything else. Corners count quanta, a power of two, from the leaf's
lower corner: rounding moves them by half a quantum, which is no more than float32 rounds coordinates by where a leaf
is smaller than 1/512 of the mesh, and part of the margin anywhere.

The test projects corners along the ray (its largest component is z, x and y are sheared) and asks whether the ray's
place is within the triangle, either way around. A ray that hits the true triangle at weights u, v, w is as far from
the point of those weights in the rounded triangle as the corners and the ray itself were moved, d at most; then no edge
function, from the ray, is further on the wrong side than d times the length of that edge. That is the margin: no hit is
passed by, for slivers and triangles without area as for others. What passes is decided in float64.
"""

# Words of a leaf: nine rows of eight 16-bit numbers (x, y, z of three corners), then the HEAD.
LEAF_WORDS = 48
HEAD = 36
# Height of a triangle over its longest edge, below which t is that of the plane; see ray_triangle_kernels.
SLIVER = 1e-3
# What rounding moves a ray by across its direction, in local units: coordinates up to 2, differences up to 3, and
# slopes times those, rounded by 6e-8 each, come to 1.3e-6 in the worst case.
RAY_ERROR = 2.5e-6
# A quantum is not smaller than this: 1 / quantum, and its products with what RAY_ERROR leaves, stay small in float32.
LEAST_QUANTUM = 2.0**-30

# What makes a leaf. In its head: lower corner 0-2, quanta per unit 3, margin of the edge functions 4 and of depths 5,
# bits 6 (of triangles that there are 0-7, of slivers 8-15). Names that the text expects: block, slot_triangle, corners,
# leaves (of which a block has PLANE_WORDS words), origin, scale, out_leaves.
PACK_LEAF = f"""
    typedef double d8 __attribute__((ext_vector_type(8), aligned(8)));
    typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));
    typedef unsigned short h8 __attribute__((ext_vector_type(8), aligned(2)));
    const double* const corner = (const double*)(corners.data + 24 * (wp::int64)block);
    const float* const plane = leaves.data + PLANE_WORDS * (wp::int64)block;
    float* const word = out_leaves.data + {LEAF_WORDS} * (wp::int64)block;
    float* const head = word + {HEAD};
    const double local = 1.0 / scale;
    unsigned there = 0, slivers = 0;
    int filled = 0;
    for (int lane = 0; lane < 8; ++lane) {{
        if (slot_triangle.data[8 * block + lane] < 0) continue;
        there |= 1u << lane;
        filled = lane;
        if (plane[8 * 14 + lane] < {SLIVER}f * plane[8 * 12 + lane]) slivers |= 1u << lane;
    }}
    // Corners by axis; empty lanes take those of a triangle that there is.
    double column[9][8];
    for (int lane = 0; lane < 8; ++lane) {{
        const double* const from = corner + 9 * (there >> lane & 1 ? lane : filled);
        for (int i = 0; i < 9; ++i) column[i][lane] = from[i];
    }}
    d8 at[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) at[i][k] = (*(const d8*)column[3 * i + k] - origin[k]) * local;
    double extent = 0.0, quantum = {LEAST_QUANTUM};
    for (int k = 0; k < 3; ++k) {{
        const d8 low = __builtin_elementwise_min(__builtin_elementwise_min(at[0][k], at[1][k]), at[2][k]);
        const d8 high = __builtin_elementwise_max(__builtin_elementwise_max(at[0][k], at[1][k]), at[2][k]);
        double lower = low[0], upper = high[0];
        for (int lane = 1; lane < 8; ++lane) {{
            lower = low[lane] < lower ? low[lane] : lower;
            upper = high[lane] > upper ? high[lane] : upper;
        }}
        const float nearest = (float)lower;
        head[k] = nearest - 1.2e-7f * (nearest < 0.f ? -nearest : nearest) - 1e-30f;
        extent = upper - head[k] > extent ? upper - head[k] : extent;
    }}
    while (quantum * 65535.0 < extent) quantum *= 2.0;
    const double quanta = 1.0 / quantum;
    v8 q[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {{
            const i8 whole = __builtin_convertvector((at[i][k] - (double)head[k]) * quanta + 0.5, i8);
            *(h8*)((unsigned short*)word + 8 * (3 * i + k)) = __builtin_convertvector(whole, h8);
            q[i][k] = __builtin_convertvector(whole, v8);
        }}
    v8 longest2 = 0.f;
    for (int i = 0; i < 3; ++i) {{
        const int j = (i + 1) % 3;
        const v8 x = q[i][0] - q[j][0], y = q[i][1] - q[j][1], z = q[i][2] - q[j][2];
        longest2 = __builtin_elementwise_max(longest2, x * x + y * y + z * z);
    }}
    float most = longest2[0];
    for (int lane = 1; lane < 8; ++lane) most = longest2[lane] > most ? longest2[lane] : most;
    // Shearing moves a corner that is off by half a quantum an axis by 1.42 at most, and makes an edge longer by 1.74
    // at most; rounding in products of up to 2^17 quanta each comes to 3e3.
    const double moved = 2.0 + {RAY_ERROR} * quanta;
    head[3] = (float)quanta;
    head[4] = (float)(1.74 * moved * wp::sqrt((double)most) + 1e4);
    head[5] = (float)moved;
    ((unsigned*)head)[6] = there | slivers << 8;
    for (int i = 7; i < {LEAF_WORDS - HEAD}; ++i) head[i] = 0.f;
"""

# Which triangles of a leaf a ray may hit: lanes. Names that the text expects: r (the ray), block (of the leaf), and
# those of the walk.
LEAF_TEST = f"""
    const unsigned short* const row = (const unsigned short*)(tree.ray_leaves.data + {LEAF_WORDS} * (wp::int64)block);
    const float* const head = tree.ray_leaves.data + {LEAF_WORDS} * (wp::int64)block + {HEAD};
    const int kz = r.row[AXIS], kx = kz == 0, ky = 2 - (kz == 2);
    // The ray's start in the leaf's quanta.
    const float rate = head[3], sx = r.field[SHEAR], sy = r.field[SHEAR + 1], az = (r.field[AT + 2] - head[kz]) * rate;
    const float ax = (r.field[AT] - head[kx]) * rate - sx * az, ay = (r.field[AT + 1] - head[ky]) * rate - sy * az;
    auto coordinate = [&](int i) {{
        return __builtin_convertvector(__builtin_convertvector(*(const h8*)(row + 8 * i), i8), v8);
    }};
    const v8 z0 = coordinate(kz), z1 = coordinate(kz + 3), z2 = coordinate(kz + 6);
    const v8 x0 = (coordinate(kx) - sx * z0) - ax, y0 = (coordinate(ky) - sy * z0) - ay;
    const v8 x1 = (coordinate(kx + 3) - sx * z1) - ax, y1 = (coordinate(ky + 3) - sy * z1) - ay;
    const v8 x2 = (coordinate(kx + 6) - sx * z2) - ax, y2 = (coordinate(ky + 6) - sy * z2) - ay;
    const v8 e0 = x1 * y2 - y1 * x2, e1 = x2 * y0 - y2 * x0, e2 = x0 * y1 - y0 * x1;
    const v8 low = smaller(smaller(e0, e1), e2), high = larger(larger(e0, e1), e2);
    // The hit is as deep as one of the corners at least, and as one of them at most.
    const float forward = r.field[FORWARD], depth = az * forward, limit = r.field[LAST] * rate;
    const v8 d0 = z0 * forward, d1 = z1 * forward, d2 = z2 * forward;
    const v8 nearest = smaller(smaller(d0, d1), d2), farthest = larger(larger(d0, d1), d2);
    const unsigned lanes = ((const unsigned*)head)[6] & 0xffu
                           & mask_of(((low >= -head[4]) | (high <= head[4])) & (farthest >= depth - head[5])
                                     & (nearest <= depth + limit + head[5]));
"""
