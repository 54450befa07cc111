// Weighted sums over the stencils of float grids: see stencil_kernels. Most grids hold floats. They are read inside the
// loops, through one accessor whose cached nodes serve the whole stencil: this takes half the time of the rows of any
// type.

// Sums over the count^3 voxels (count is 3 or 4) from (i, j, k) on, of differences from the voxel at the lower corner of
// the point's cell, which is returned. x, y and z have for each axis rows of the weights and of their derivatives. There
// is one sum, for the value; or three, for its derivatives along i, j and k; or nine, for these and then the second ones
// along (i, i), (j, j), (k, k), (j, k), (i, k) and (i, j).
static constexpr auto add_voxels = [](unsigned long long volume, int i, int j, int k, const wp::mat44d& x,
                                      const wp::mat44d& y, const wp::mat44d& z, auto& sums) -> double {
    constexpr bool first = sizeof(sums) >= 3 * sizeof(double), second = sizeof(sums) == 9 * sizeof(double);
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
    const double center = voxel(node_of(i + 1, j + 1, k + 1), own);
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
            double r0 = 0.0, r1 = 0.0, r2 = 0.0;
            for (int s = 0; s < count; ++s) {
                const double value = voxel(s < cut_k ? near : far, n + (unsigned)((k + s) & 7)) - center;
                r0 += z.data[0][s] * value;
                if constexpr (first) r1 += z.data[1][s] * value;
                if constexpr (second) r2 += z.data[2][s] * value;
            }
            const double w00 = x.data[0][p] * y.data[0][q];
            if constexpr (!first) {
                sums += w00 * r0;
            } else {
                const double w01 = x.data[0][p] * y.data[1][q], w10 = x.data[1][p] * y.data[0][q];
                sums[0] += w10 * r0;
                sums[1] += w01 * r0;
                sums[2] += w00 * r1;
                if constexpr (second) {
                    sums[3] += x.data[2][p] * y.data[0][q] * r0;
                    sums[4] += x.data[0][p] * y.data[2][q] * r0;
                    sums[5] += w00 * r2;
                    sums[6] += w01 * r1;
                    sums[7] += w10 * r1;
                    sums[8] += x.data[1][p] * y.data[1][q] * r0;
                }
            }
        }
    }
    return center;
};

static constexpr auto float_value = [](unsigned long long volume, int i, int j, int k, const auto& basis,
                                       const wp::mat44d& x, const wp::mat44d& y, const wp::mat44d& z) -> double {
    double sum = 0.0;
    const double center = add_voxels(volume, i, j, k, x, y, z, sum);
    return center + sum;
};
static constexpr auto float_gradient = [](unsigned long long volume, int i, int j, int k, const auto& basis,
                                          const wp::mat44d& x, const wp::mat44d& y, const wp::mat44d& z) -> wp::vec3d {
    wp::vec3d sums = {};
    add_voxels(volume, i, j, k, x, y, z, sums);
    return sums;
};
static constexpr auto float_hessian = [](unsigned long long volume, int i, int j, int k, const auto& basis,
                                         const wp::mat44d& x, const wp::mat44d& y, const wp::mat44d& z) {
    wp::vec_t<9, double> sums = {};
    add_voxels(volume, i, j, k, x, y, z, sums);
    return sums;
};
