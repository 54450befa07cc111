// Writes the eight triangles of one block: their world corners, and their planes as leaf_planes_kernels describes them.
// The arithmetic is that of fill_leaf there, in the same order, eight triangles at a time.
//
// Expects core/simd.inl; block, slot_triangle, vertices, faces, origin, scale, out_corners, out_leaves; WIDTH,
// PLANE_ROWS, NOWHERE, FLAT, SHORTEST.
#if !defined(__CUDA_ARCH__)
const int* triangle = slot_triangle.data + (wp::int64)WIDTH * block;
wp::vec_t<3, wp::float64>* corner = out_corners.data + (wp::int64)3 * WIDTH * block;
double placed[9][WIDTH];
for (int j = 0; j < WIDTH; ++j)
    for (int k = 0; k < 3; ++k) {
        const double none = __builtin_nan("");
        wp::vec_t<3, wp::float64> p(none, none, none);
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
#endif
