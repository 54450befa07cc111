// Weighted sums over the count^3 voxels of a float grid from (i, j, k) on. Most grids hold floats. Floats are read
// inside the loops, through one accessor whose cached nodes serve the whole stencil: this takes half the time of the
// rows of any type.
//
// Expects volume, i, j, k; the constant count (3 or 4); x, y, z: for each axis rows of the weights and of their
// derivatives; the macro DERIVATIVES: 0 for the value, 1 for its derivatives along i, j and k, 2 for these and then
// the second ones along (i, i), (j, j), (k, k), (j, k), (i, k) and (i, j). Returns a double or a wp::vec_t of 3 or 9.
const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
pnanovdb_readaccessor_t accessor;
pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
struct Node {
    unsigned long long begin, step;
};
// Offset of a leaf's first voxel, and the step between voxels: 0 for a tile, whose voxels share one value.
auto node_of = [&](int a, int b, int c) -> Node {
    const pnanovdb_coord_t ijk = {a, b, c};
    unsigned level;
    const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
        PNANOVDB_GRID_TYPE_FLOAT, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    if (level != 0u) return {at.byte_offset, 0u};
    return {pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, accessor.leaf, 0u).byte_offset, 4u};
};
auto voxel = [&](Node node, unsigned n) -> double {
    const pnanovdb_address_t at = {node.begin + n * node.step};
    return (double)pnanovdb_read_float(buf, at);
};
const int cut_j = wp::min(count, 8 - (j & 7)), cut_k = wp::min(count, 8 - (k & 7));
const unsigned own = (unsigned)(((i + 1) & 7) << 6 | ((j + 1) & 7) << 3 | ((k + 1) & 7));
// Sums run over differences from the voxel at the lower corner of the point's cell.
const double center = voxel(node_of(i + 1, j + 1, k + 1), own);
#if DERIVATIVES == 0
double sums = {};
#elif DERIVATIVES == 1
wp::vec_t<3, double> sums = {};
#else
wp::vec_t<9, double> sums = {};
#endif
Node n00, n01, n10, n11;
for (int p = 0; p < count; ++p) {
    if (p == 0 || ((i + p) & 7) == 0) {
        n00 = node_of(i + p, j, k);
        n01 = cut_k < count ? node_of(i + p, j, k + cut_k) : n00;
        n10 = cut_j < count ? node_of(i + p, j + cut_j, k) : n00;
        n11 = cut_j < count ? (cut_k < count ? node_of(i + p, j + cut_j, k + cut_k) : n10) : n01;
    }
    for (int q = 0; q < count; ++q) {
        const Node near = q < cut_j ? n00 : n10, far = q < cut_j ? n01 : n11;
        const unsigned n = (unsigned)(((i + p) & 7) << 6 | ((j + q) & 7) << 3);
        // Sums of a row along k, by the weights and their derivatives.
        double r0 = 0.0;
#if DERIVATIVES >= 1
        double r1 = 0.0;
#endif
#if DERIVATIVES >= 2
        double r2 = 0.0;
#endif
        for (int s = 0; s < count; ++s) {
            const double value = voxel(s < cut_k ? near : far, n + (unsigned)((k + s) & 7)) - center;
            r0 += z.data[0][s] * value;
#if DERIVATIVES >= 1
            r1 += z.data[1][s] * value;
#endif
#if DERIVATIVES >= 2
            r2 += z.data[2][s] * value;
#endif
        }
        const double w00 = x.data[0][p] * y.data[0][q];
#if DERIVATIVES == 0
        sums += w00 * r0;
#else
        const double w01 = x.data[0][p] * y.data[1][q];
#if DERIVATIVES >= 2
        const double w02 = x.data[0][p] * y.data[2][q];
#endif
        const double w10 = x.data[1][p] * y.data[0][q];
#if DERIVATIVES >= 2
        const double w11 = x.data[1][p] * y.data[1][q];
        const double w20 = x.data[2][p] * y.data[0][q];
#endif
        sums[0] += w10 * r0;
        sums[1] += w01 * r0;
        sums[2] += w00 * r1;
#if DERIVATIVES >= 2
        sums[3] += w20 * r0;
        sums[4] += w02 * r0;
        sums[5] += w00 * r2;
        sums[6] += w01 * r1;
        sums[7] += w10 * r1;
        sums[8] += w11 * r0;
#endif
#endif
    }
}
#if DERIVATIVES == 0
return center + sums;
#else
return sums;
#endif
