// Packs a leaf for rays, on the CPU: eight triangles in three cache lines, corners in 16 bits an axis.
//
// Rays wait longest for the cache lines of leaves. Corners are counted in quanta, a power of two, from the leaf's lower
// corner. Rounding moves them by half a quantum: where a leaf is smaller than 1/512 of the mesh, no more than float32
// rounds coordinates; elsewhere the margin includes it.
//
// A leaf is nine rows of eight 16-bit numbers (x, y, z of three corners), then a head: lower corner 0-2, quanta per
// unit 3, margin of the edge functions 4 and of depths 5, bits 6 (of filled lanes 0-7, of slivers 8-15).
//
// Expects core/simd.inl; block, slot_triangle, corners, leaves, origin, scale, out_leaves; LEAF_WORDS, HEAD,
// PLANE_ROWS, SLIVER, RAY_ERROR, LEAST_QUANTUM.
#if !defined(__CUDA_ARCH__)
const double* const corner = (const double*)(corners.data + 24 * (wp::int64)block);
const float* const plane = leaves.data + 8 * PLANE_ROWS * (wp::int64)block;
float* const word = out_leaves.data + LEAF_WORDS * (wp::int64)block;
float* const head = word + HEAD;
const double local = 1.0 / scale;
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
// Shearing moves a corner with an error of half a quantum per axis by at most 1.42, and lengthens an edge by at most
// 1.74; rounding in products of up to 2^17 quanta each adds up to 3e3.
const double moved = 2.0 + RAY_ERROR * quanta;
head[3] = (float)quanta;
head[4] = (float)(1.74 * moved * wp::sqrt((double)most) + 1e4);
head[5] = (float)moved;
((unsigned*)head)[6] = there | slivers << 8;
for (int i = 7; i < LEAF_WORDS - HEAD; ++i) head[i] = 0.f;
#endif
