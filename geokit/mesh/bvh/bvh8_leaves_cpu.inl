// The leaves of the CPU's trees, eight triangles each: their corners and planes, and what rays read.
#include "core/parts.inl"
#include "core/simd.inl"

// Writes the eight triangles of one block: their world corners, and their planes as leaf_planes_kernels describes them.
// The arithmetic is that of leaf_planes_kernel there, in the same order, eight triangles at a time.
static constexpr auto place_block = [](int block, const wp::array_t<int>& begin, const wp::array_t<int>& slot_triangle,
                                       const wp::array_t<wp::vec3d>& vertices, const wp::array_t<int>& faces,
                                       const wp::array_t<wp::vec3d>& origins, const wp::array_t<double>& scales,
                                       wp::array_t<wp::vec3d>& out_corners, wp::array_t<float>& out_leaves) {
    const int tree = part_of(begin, WIDTH * block);
    const wp::vec3d& origin = origins.data[tree];
    const double scale = scales.data[tree];
    const int* triangle = slot_triangle.data + (wp::int64)WIDTH * block;
    wp::vec3d* corner = out_corners.data + (wp::int64)3 * WIDTH * block;
    double placed[9][WIDTH];
    for (int j = 0; j < WIDTH; ++j)
        for (int k = 0; k < 3; ++k) {
            const double none = __builtin_nan("");
            wp::vec3d p(none, none, none);
            if (triangle[j] >= 0) p = vertices.data[faces.data[(wp::int64)3 * triangle[j] + k]];
            corner[3 * j + k] = p;
            for (int axis = 0; axis < 3; ++axis) placed[3 * k + axis][j] = p[axis];
        }
    const auto here = __builtin_convertvector(*(const i8*)triangle, d8) >= 0.0;
    d8 a[3], b[3], c[3], ab[3], bc[3], ca[3];
    for (int k = 0; k < 3; ++k) {
        const double nowhere = k ? 0.0 : NOWHERE;
        a[k] = here ? (*(const d8*)placed[k] - origin[k]) / scale : nowhere;
        b[k] = here ? (*(const d8*)placed[3 + k] - origin[k]) / scale : nowhere;
        c[k] = here ? (*(const d8*)placed[6 + k] - origin[k]) / scale : nowhere;
        ab[k] = b[k] - a[k];
        bc[k] = c[k] - b[k];
        ca[k] = a[k] - c[k];
    }
    auto dot = [](const d8* p, const d8* q) { return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]; };
    auto length_of = [&](const d8* p) { return __builtin_elementwise_sqrt(dot(p, p)); };
    // v over its length, or v itself where that is zero.
    auto normalize = [&](d8* v) {
        d8 size = length_of(v);
        size = size > 0.0 ? size : 1.0;
        for (int k = 0; k < 3; ++k) v[k] = v[k] / size;
    };
    // Rotated so that the longest edge runs from a to b: then c is well away from both.
    const d8 ab2 = dot(ab, ab), bc2 = dot(bc, bc), ca2 = dot(ca, ca);
    const auto once = (bc2 > ab2) & (bc2 >= ca2), twice = ~once & (ca2 > ab2);
    d8 x[3], y[3], z[3], rest[3];
    for (int k = 0; k < 3; ++k) {
        const d8 p = a[k], q = b[k], r = c[k];
        a[k] = once ? q : twice ? r : p;
        b[k] = once ? r : twice ? p : q;
        c[k] = once ? p : twice ? q : r;
        x[k] = ab[k] = b[k] - a[k];
        ca[k] = c[k] - a[k];
    }
    auto larger = [](const d8& p, const d8& q) { return p > q ? p : q; };
    auto magnitude = [](const d8& p) { return __builtin_elementwise_abs(p); };
    const d8 size = larger(larger(magnitude(x[0]), magnitude(x[1])), magnitude(x[2]));
    const auto some = size > 0.0;
    for (int k = 0; k < 3; ++k) x[k] = some ? x[k] / (some ? size : 1.0) : k ? 0.0 : 1.0;
    normalize(x);
    const d8 cx = dot(ca, x);
    for (int k = 0; k < 3; ++k) {
        const d8 along = cx * x[k];
        rest[k] = ca[k] - along;
    }
    // Without area, the component of c off the edge is rounding in any direction: any plane through the edge will do.
    const d8 height = length_of(rest), edge = length_of(ab);
    const auto flat = ~(height > FLAT * edge);
    // Across the edge: from the axis that it is far from, orthogonalized.
    const auto steep = magnitude(x[0]) > 0.7;
    const d8 part = steep ? x[1] : x[0];
    for (int k = 0; k < 3; ++k) {
        const d8 along = part * x[k], axis = k == 0 ? (steep ? 0.0 : 1.0) : k == 1 ? (steep ? 1.0 : 0.0) : 0.0;
        const d8 across = axis - along;
        y[k] = flat ? across : rest[k];
    }
    normalize(y);
    // Orthogonalized against x once more: a remaining component along x would tilt the plane of a sliver.
    const d8 lean = dot(y, x);
    d8 upright[3];
    for (int k = 0; k < 3; ++k) {
        const d8 along = lean * x[k];
        upright[k] = y[k] - along;
    }
    normalize(upright);
    for (int k = 0; k < 3; ++k) y[k] = flat ? y[k] : upright[k];
    z[0] = x[1] * y[2] - x[2] * y[1];
    z[1] = x[2] * y[0] - x[0] * y[2];
    z[2] = x[0] * y[1] - x[1] * y[0];
    // No point is inside an edge of negative length, whatever the margin.
    const d8 cy = dot(ca, y), length = here ? dot(ab, x) : -1.0;
    // Shorter lengths count as zero, because their reciprocal would overflow float32.
    auto reciprocal = [](const d8& p) { return p > SHORTEST ? 1.0 / (p > SHORTEST ? p : 1.0) : 0.0; };
    const d8 cy2 = cy * cy, cx2 = cx * cx, dx = cx - length, dx2 = dx * dx;
    v8* row = (v8*)(out_leaves.data + (wp::int64)WIDTH * PLANE_ROWS * block);
    auto put = [&](int at, const d8& value) { row[at] = __builtin_convertvector(value, v8); };
    for (int k = 0; k < 3; ++k) {
        put(k, a[k]);
        put(3 + k, x[k]);
        put(6 + k, y[k]);
        put(9 + k, z[k]);
    }
    put(12, length);
    put(13, cx);
    put(14, cy);
    put(15, reciprocal(cx2 + cy2));
    put(16, reciprocal(dx2 + cy2));
};

// Packs a leaf for rays: eight triangles in three cache lines, corners in 16 bits an axis.
//
// Rays wait longest for the cache lines of leaves. Corners are counted in quanta, a power of two, from the leaf's lower
// corner. Rounding moves them by half a quantum: where a leaf is smaller than 1/512 of the mesh, no more than float32
// rounds coordinates; elsewhere the margin includes it.
//
// A leaf is nine rows of eight 16-bit numbers (x, y, z of three corners), then a head: lower corner 0-2, quanta per
// unit 3, margin of the edge functions 4 and of depths 5, bits 6 (of filled lanes 0-7, of slivers 8-15).
static constexpr auto pack_leaf = [](int block, const wp::array_t<int>& begin, const wp::array_t<int>& slot_triangle,
                                     const wp::array_t<wp::vec3d>& corners, const wp::array_t<float>& leaves,
                                     const wp::array_t<wp::vec3d>& origins, const wp::array_t<double>& scales,
                                     wp::array_t<float>& out_leaves) {
    const int tree = part_of(begin, WIDTH * block);
    const wp::vec3d& origin = origins.data[tree];
    const double* const corner = (const double*)(corners.data + 24 * (wp::int64)block);
    const float* const plane = leaves.data + 8 * PLANE_ROWS * (wp::int64)block;
    float* const word = out_leaves.data + LEAF_WORDS * (wp::int64)block;
    float* const head = word + HEAD;
    const double local = 1.0 / scales.data[tree];
    unsigned there = 0, slivers = 0;
    int filled = 0;
    for (int lane = 0; lane < 8; ++lane) {
        if (slot_triangle.data[8 * block + lane] < 0) continue;
        there |= 1u << lane;
        filled = lane;
        if (plane[8 * 14 + lane] < SLIVER * plane[8 * 12 + lane]) slivers |= 1u << lane;
    }
    // Corners by axis; empty lanes take those of a filled one.
    double column[9][8];
    for (int lane = 0; lane < 8; ++lane) {
        const double* const from = corner + 9 * (there >> lane & 1 ? lane : filled);
        for (int i = 0; i < 9; ++i) column[i][lane] = from[i];
    }
    d8 at[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) at[i][k] = (*(const d8*)column[3 * i + k] - origin[k]) * local;
    double extent = 0.0, quantum = LEAST_QUANTUM;
    for (int k = 0; k < 3; ++k) {
        const d8 low = __builtin_elementwise_min(__builtin_elementwise_min(at[0][k], at[1][k]), at[2][k]);
        const d8 high = __builtin_elementwise_max(__builtin_elementwise_max(at[0][k], at[1][k]), at[2][k]);
        double lower = low[0], upper = high[0];
        for (int lane = 1; lane < 8; ++lane) {
            lower = low[lane] < lower ? low[lane] : lower;
            upper = high[lane] > upper ? high[lane] : upper;
        }
        const float nearest = (float)lower;
        head[k] = nearest - 1.2e-7f * (nearest < 0.f ? -nearest : nearest) - 1e-30f;
        extent = upper - head[k] > extent ? upper - head[k] : extent;
    }
    while (quantum * 65535.0 < extent) quantum *= 2.0;
    const double quanta = 1.0 / quantum;
    v8 q[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
            const i8 whole = __builtin_convertvector((at[i][k] - (double)head[k]) * quanta + 0.5, i8);
            *(h8*)((unsigned short*)word + 8 * (3 * i + k)) = __builtin_convertvector(whole, h8);
            q[i][k] = __builtin_convertvector(whole, v8);
        }
    v8 longest2 = 0.f;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const v8 x = q[i][0] - q[j][0], y = q[i][1] - q[j][1], z = q[i][2] - q[j][2];
        longest2 = __builtin_elementwise_max(longest2, x * x + y * y + z * z);
    }
    float most = longest2[0];
    for (int lane = 1; lane < 8; ++lane) most = longest2[lane] > most ? longest2[lane] : most;
    // Shearing moves a corner with an error of half a quantum per axis by at most 1.42, and lengthens an edge by at
    // most 1.74; rounding in products of up to 2^17 quanta each adds up to 3e3.
    const double moved = 2.0 + RAY_ERROR * quanta;
    head[3] = (float)quanta;
    head[4] = (float)(1.74 * moved * wp::sqrt((double)most) + 1e4);
    head[5] = (float)moved;
    ((unsigned*)head)[6] = there | slivers << 8;
    for (int i = 7; i < LEAF_WORDS - HEAD; ++i) head[i] = 0.f;
};
