// Slope of the field at a point of the surface, and its gradient: see interface_distance_kernels. They come from a linear
// fit to the slopes of crossed cells within two voxels; if these do not fit a linear function, the slope is their upper
// quartile. It is C++ because the quartile needs a local array.
//   0.05: variance of the cells' positions [voxels^2] that counts as none; along a surface it is about 1. Crossed cells
//     of a flat surface lie in a plane, and this keeps the system regular.
//   0.02: relative scatter of slopes around a linear function where the field is smooth; at edges it is 0.1.
//   0.75: where faces meet in an edge, cells on the edge have smaller slopes than the faces'; they are a minority.
static constexpr auto slope_near = [](const wp::array_t<float>& slopes, const wp::array_t<int>& beside, int t, int x,
                                      int y, int z, const wp::vec3d& point) -> wp::vec4d {
    const int* const rows = beside.data + 27 * t;
    double slope[64];
    // Sums over the cells. Positions are relative to the voxel, so that their squares lose no digits.
    double sum[3] = {0.0, 0.0, 0.0}, m[3][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    double along[3] = {0.0, 0.0, 0.0}, mean = 0.0, square = 0.0;
    int count = 0;
    for (int i = -2; i < 2; ++i)
        for (int j = -2; j < 2; ++j) {
            const int a = x + i, b = y + j, side = 9 * (a >> 3) + 3 * (b >> 3) + 13;
            for (int k = -2; k < 2; ++k) {
                const int row = rows[side + ((z + k) >> 3)];
                if (row < 0) continue;
                const double s = slopes.data[(row << 9) + ((a & 7) << 6) + ((b & 7) << 3) + ((z + k) & 7)];
                if (!(s >= 0.0)) continue;
                const double d[3] = {i + 0.5, j + 0.5, k + 0.5};
                for (int e = 0; e < 3; ++e) {
                    for (int f = e; f < 3; ++f) m[e][f] += d[e] * d[f];
                    sum[e] += d[e];
                    along[e] += d[e] * s;
                }
                mean += s;
                square += s * s;
                slope[count++] = s;
            }
        }
    if (count == 0) return {1.0, 0.0, 0.0, 0.0};
    const double share = 1.0 / count;
    mean *= share;
    square = square * share - mean * mean;
    for (int e = 0; e < 3; ++e) sum[e] *= share;
    for (int e = 0; e < 3; ++e) {
        for (int f = e; f < 3; ++f) m[f][e] = m[e][f] = m[e][f] * share - sum[e] * sum[f] + (e == f ? 0.05 : 0.0);
        along[e] = along[e] * share - sum[e] * mean;
    }
    const double xx = m[1][1] * m[2][2] - m[1][2] * m[1][2], xy = m[0][2] * m[1][2] - m[0][1] * m[2][2];
    const double xz = m[0][1] * m[1][2] - m[0][2] * m[1][1], yy = m[0][0] * m[2][2] - m[0][2] * m[0][2];
    const double yz = m[0][1] * m[0][2] - m[0][0] * m[1][2], zz = m[0][0] * m[1][1] - m[0][1] * m[0][1];
    const double inverse = 1.0 / (m[0][0] * xx + m[0][1] * xy + m[0][2] * xz);
    const double rise[3] = {(xx * along[0] + xy * along[1] + xz * along[2]) * inverse,
                            (xy * along[0] + yy * along[1] + yz * along[2]) * inverse,
                            (xz * along[0] + yz * along[1] + zz * along[2]) * inverse};
    const double explained = rise[0] * along[0] + rise[1] * along[1] + rise[2] * along[2];
    if (square - explained < 0.02 * 0.02 * mean * mean) {
        double fitted = mean;
        for (int e = 0; e < 3; ++e) fitted += rise[e] * (point[e] - sum[e]);
        return {fitted, rise[0], rise[1], rise[2]};
    }
    const int rank = (int)(0.75 * (count - 1) + 0.5);
    for (int n = 1; n < count; ++n) {
        const double s = slope[n];
        int at = n;
        for (; at > 0 && slope[at - 1] > s; --at) slope[at] = slope[at - 1];
        slope[at] = s;
    }
    return {slope[rank], 0.0, 0.0, 0.0};
};
