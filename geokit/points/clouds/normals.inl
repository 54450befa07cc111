// Rows of neighbors, see normals_kernels. In C++, because warp accesses arrays through their strides, which takes longer
// here than the sums.

// Sums of the differences of the first `count` neighbors to point i, and of the products of these differences:
// (x, y, z), (xx, xy, xz), (yy, yz, zz).
static constexpr auto row_sums = [](const wp::array_t<wp::vec3d>& points, const wp::array_t<int>& neighbor, int i,
                                    int count, double scale) {
    const int* const row = neighbor.data + (int64_t)i * neighbor.shape[1];
    const double px = points.data[i][0], py = points.data[i][1], pz = points.data[i][2];
    double sx = 0.0, sy = 0.0, sz = 0.0, xx = 0.0, xy = 0.0, xz = 0.0, yy = 0.0, yz = 0.0, zz = 0.0;
    for (int k = 0; k < count; ++k) {
        const double* const q = (const double*)(points.data + row[k]);
        const double x = (q[0] - px) * scale, y = (q[1] - py) * scale, z = (q[2] - pz) * scale;
        sx += x;
        sy += y;
        sz += z;
        xx += x * x;
        xy += x * y;
        xz += x * z;
        yy += y * y;
        yz += y * z;
        zz += z * z;
    }
    return wp::mat_t<3, 3, double>(sx, sy, sz, xx, xy, xz, yy, yz, zz);
};

static constexpr auto place_row = [](int i, const wp::array_t<int>& order, const wp::array_t<int>& place,
                                     const wp::array_t<int>& neighbor, wp::array_t<int>& out_neighbor) {
    const int width = neighbor.shape[1];
    const int* const from = neighbor.data + (int64_t)order.data[i] * width;
    int* const to = out_neighbor.data + (int64_t)i * width;
    for (int k = 0; k < width; ++k) to[k] = from[k] < 0 ? -1 : place.data[from[k]];
};
