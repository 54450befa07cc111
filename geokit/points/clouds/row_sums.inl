// Sums of the differences of the first `count` neighbors to point i, and of the products of these differences.
//
// Expects points, neighbor, i, count, scale. Returns (x, y, z), (xx, xy, xz), (yy, yz, zz).
//
// In C++, because warp accesses arrays through their strides, which takes longer here than the sums.

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
