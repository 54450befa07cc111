// Multipole moments of a node's children, and its own raw moments for its parent. bvh8_moments_kernels.py defines them.
#include "core/simd.inl"

static constexpr auto node_moments = [](const SurfaceTree& tree, const wp::array_t<bool>& flipped, int node,
                                        wp::array_t<double>& raw, wp::array_t<float>& moments,
                                        wp::array_t<float>& areas) {
// Fused products round less, and are faster.
#pragma clang fp contract(fast)
    const double inverse = 1.0 / tree.scale;
    // Products with the linear form (x, y, z) . v; the terms of polynomials are ordered by rising powers of z, then of
    // y.
    auto add_linear_by_linear = [](const d8* d, const d8* p, d8* out) {
        out[0] += d[0] * p[0];
        out[1] += d[0] * p[1] + d[1] * p[0];
        out[2] += d[1] * p[1];
        out[3] += d[0] * p[2] + d[2] * p[0];
        out[4] += d[1] * p[2] + d[2] * p[1];
        out[5] += d[2] * p[2];
    };
    auto add_linear_by_square = [](const d8* d, const d8* p, d8* out) {
        out[0] += d[0] * p[0];
        out[1] += d[0] * p[1] + d[1] * p[0];
        out[2] += d[0] * p[2] + d[1] * p[1];
        out[3] += d[1] * p[2];
        out[4] += d[0] * p[3] + d[2] * p[0];
        out[5] += d[0] * p[4] + d[1] * p[3] + d[2] * p[1];
        out[6] += d[1] * p[4] + d[2] * p[2];
        out[7] += d[0] * p[5] + d[2] * p[3];
        out[8] += d[1] * p[5] + d[2] * p[4];
        out[9] += d[2] * p[5];
    };
    auto total = [](const d8& v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); };
    auto largest = [](const d8& v) {
        double most = v[0];
        for (int j = 1; j < 8; ++j) most = v[j] > most ? v[j] : most;
        return most;
    };
    // Center, area, radius and moments of the triangles of a block.
    auto of_leaf = [&](int block, double* out) {
        double corner[9][8], sign_of[8];
        int filled = 0;
        while (filled < 8 && tree.slot_triangle.data[8 * block + filled] >= 0) ++filled;
        for (int j = 0; j < 8; ++j) {
            // Empty slots become points at the first corner.
            const int slot = 8 * block + (j < filled ? j : 0);
            const wp::vec3d* from = tree.corners.data + 3 * slot;
            const bool turned = flipped.data && flipped.data[tree.slot_triangle.data[slot]];
            sign_of[j] = turned ? -0.5 : 0.5;
            for (int k = 0; k < 9; ++k) corner[k][j] = j < filled ? from[k / 3][k % 3] : from[0][k % 3];
        }
        d8 a[3], ab[3], ac[3];
        const d8 sign = *(const d8*)sign_of;
        for (int k = 0; k < 3; ++k) {
            const d8 first = *(const d8*)corner[k];
            a[k] = (first - tree.origin[k]) * inverse;
            ab[k] = (*(const d8*)corner[3 + k] - first) * inverse;
            ac[k] = (*(const d8*)corner[6 + k] - first) * inverse;
        }
        d8 normal[3], centroid[3];
        for (int k = 0; k < 3; ++k) {
            normal[k] = sign * (ab[(k + 1) % 3] * ac[(k + 2) % 3] - ab[(k + 2) % 3] * ac[(k + 1) % 3]);
            centroid[k] = a[k] + (ab[k] + ac[k]) * (1.0 / 3.0);
        }
        const d8 area =
            __builtin_elementwise_sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        *(v8*)(areas.data + 8 * block) = __builtin_convertvector(-4.0 * sign * area, v8);
        out[3] = total(area);
        d8 squared[3] = {0.0, 0.0, 0.0};
        for (int k = 0; k < 3; ++k) {
            out[k] = out[3] > 0.0 ? total(area * centroid[k]) / out[3] : total(centroid[k]) * 0.125;
            a[k] -= out[k];
            centroid[k] -= out[k];
            const d8 b = a[k] + ab[k], c = a[k] + ac[k];
            squared[0] += a[k] * a[k];
            squared[1] += b * b;
            squared[2] += c * c;
        }
        out[4] = __builtin_sqrt(
            largest(__builtin_elementwise_max(squared[0], __builtin_elementwise_max(squared[1], squared[2]))));
        d8 s2[6] = {}, s3[10] = {}, second[6] = {};
        add_linear_by_linear(centroid, normal, s2);
        // The mean of x x over a triangle is the sum over its corners and nine times its centroid, divided by twelve.
        for (int k = 0; k < 3; ++k) {
            ab[k] += a[k];
            ac[k] += a[k];
            centroid[k] *= 3.0;
        }
        add_linear_by_linear(a, a, second);
        add_linear_by_linear(ab, ab, second);
        add_linear_by_linear(ac, ac, second);
        add_linear_by_linear(centroid, centroid, second);
        add_linear_by_square(normal, second, s3);
        for (int k = 0; k < 3; ++k) out[5 + k] = total(normal[k]);
        for (int k = 0; k < 6; ++k) out[8 + k] = total(s2[k]);
        for (int k = 0; k < 10; ++k) out[14 + k] = total(s3[k]) * (1.0 / 12.0);
    };

    double buffer[RAW_SIZE][8] = {};  // a column for each child
    unsigned present = 0;
    for (int j = 0; j < 8; ++j) {
        const int child = tree.children.data[8 * node + j];
        if (child == 0) continue;
        present |= 1u << j;
        double own[RAW_SIZE];
        if (child < 0) of_leaf(-1 - child, own);
        const double* from = child < 0 ? own : raw.data + (long long)child * RAW_SIZE;
        for (int k = 0; k < RAW_SIZE; ++k) buffer[k][j] = from[k];
    }
    d8 s[RAW_SIZE];
    for (int k = 0; k < RAW_SIZE; ++k) s[k] = *(const d8*)buffer[k];
    double* out = raw.data + (long long)node * RAW_SIZE;
    out[3] = total(s[3]);
    d8 shift[3], reach = 0.0;
    for (int k = 0; k < 3; ++k) {
        out[k] = out[3] > 0.0 ? total(s[3] * s[k]) / out[3] : total(s[k]) / __builtin_popcount(present);
        shift[k] = s[k] - out[k];
        reach += shift[k] * shift[k];
    }
    reach = __builtin_elementwise_sqrt(reach) + s[4];
    // A child lies within its ball, and within the far corner of its box.
    double radius = 0.0;
    const float* box = tree.boxes.data + 48 * node;
    for (int j = 0; j < 8; ++j) {
        if (!(present >> j & 1)) continue;
        double squared = 0.0;
        for (int k = 0; k < 3; ++k) {
            const double low = out[k] - box[8 * k + j], high = box[24 + 8 * k + j] - out[k];
            const double far = low > high ? low : high;
            squared += far * far;
        }
        const double corner = __builtin_sqrt(squared), ball = reach[j];
        const double least = corner < ball ? corner : ball;
        radius = least > radius ? least : radius;
    }
    out[4] = radius;
    // Shifted to the common center: S_2 gains d S_1, and S_3 gains 2 d S_2 + d d S_1.
    d8 product[6] = {}, s2[6], s3[10];
    add_linear_by_linear(shift, s + 5, product);
    for (int k = 0; k < 6; ++k) {
        s2[k] = s[8 + k] + product[k];
        product[k] += 2.0 * s[8 + k];
    }
    for (int k = 0; k < 10; ++k) s3[k] = s[14 + k];
    add_linear_by_square(shift, product, s3);
    for (int k = 0; k < 3; ++k) out[5 + k] = total(s[5 + k]);
    for (int k = 0; k < 6; ++k) out[8 + k] = total(s2[k]);
    for (int k = 0; k < 10; ++k) out[14 + k] = total(s3[k]);

    // Harmonic parts of the children's own moments, with the factors of the sum over the orders.
    const double unit = -0.25 / 3.14159265358979323846;
    float* row = moments.data + (long long)node * 8 * MOMENT_ROWS;
    auto put = [&](int r, const d8& value) { *(v8*)(row + 8 * r) = __builtin_convertvector(value, v8); };
    for (int k = 0; k < 3; ++k) put(k, s[k]);
    const d8 ball = s[4] + RADIUS_SLACK;
    put(3, ball * ball);
    for (int k = 0; k < 3; ++k) put(4 + k, unit * s[5 + k]);
    const d8 trace = (s[8] + s[10] + s[13]) * (1.0 / 3.0);
    put(7, 3.0 * unit * (s[8] - trace));
    put(8, 3.0 * unit * s[9]);
    put(9, 3.0 * unit * (s[10] - trace));
    put(10, 3.0 * unit * s[11]);
    put(11, 3.0 * unit * s[12]);
    // A tenth of the Laplacian, a linear form.
    const d8 x = (3.0 * s[14] + s[16] + s[21]) * 0.2, y = (s[15] + 3.0 * s[17] + s[22]) * 0.2;
    const d8 z = (s[18] + s[20] + 3.0 * s[23]) * 0.2;
    put(12, 7.5 * unit * (s[14] - x));
    put(13, 7.5 * unit * (s[15] - y));
    put(14, 7.5 * unit * (s[16] - x));
    put(15, 7.5 * unit * (s[17] - y));
    put(16, 7.5 * unit * (s[18] - z));
    put(17, 7.5 * unit * s[19]);
    put(18, 7.5 * unit * (s[20] - z));
    for (int j = 0; j < 8; ++j)
        if (!(present >> j & 1)) {
            row[j] = NOWHERE;
            row[24 + j] = 0.f;
        }
};
