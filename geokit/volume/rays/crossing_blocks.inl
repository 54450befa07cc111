// The blocks that may hold a crossing of an isovalue, and their cells: see crossing_blocks_kernels.
#include "volume/nanovdb/cached_accessor.inl"

// Marks the blocks of a row along z that may hold a crossing. The cells of a block read the voxels of the block and
// the first layer of the seven blocks above it. A block holds no crossing only if all of these are on the same side
// of the isovalue; NaN and the isovalue itself are on neither side.
static constexpr auto mark_row = [](int row, unsigned long long volume, const wp::vec3i& anchor,
                                    const wp::vec3i& first_block, const wp::vec3i& block_count, auto below, auto above,
                                    wp::array_t<int>& out_busy) {
    typedef decltype(below + below) real;
    auto in = opened(volume, anchor, real());
    int ignored;
    auto look = [&](address node, int x, int y, int z, int nx, int ny, int nz, bool& over, bool& under) {
        for (int i = 0; i < nx && (over || under); ++i)
            for (int j = 0; j < ny; ++j)
                for (int k = 0; k < nz; ++k) {
                    const real v = voxel(in, node, x + i, y + j, z + k);
                    over = over & (v > (real)below);
                    under = under & (v < (real)above);
                }
    };
    const int row_x = row / block_count[1], row_y = row % block_count[1];
    const bool is_border = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
    const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
    int* out = out_busy.data + (address)row * block_count[2];
    // The prefix sum that follows has one element more than there are blocks.
    if (row == 0) out_busy.data[(address)block_count[0] * block_count[1] * block_count[2]] = 0;
    for (int n = 0; n < block_count[2]; ++n) {
        const int z = 8 * (first_block[2] + n);
        bool over = true, under = true;
        for (int m = 0; m < 8 && (over || under) && !is_border && n > 0 && n < block_count[2] - 1; ++m) {
            const int i = x + 2 * (m & 4), j = y + 4 * (m & 2), k = z + 8 * (m & 1);
            const address node = find(in, i, j, k, ignored);
            if (!(node & 1)) look(node, i, j, k, 1, 1, 1, over, under);
            else if (m == 0) look(node, i, j, k, 8, 8, 8, over, under);
            else look(node, i, j, k, m & 4 ? 1 : 8, m & 2 ? 1 : 8, m & 1 ? 1 : 8, over, under);
        }
        out[n] = over || under ? 0 : 1;
    }
};

// Writes the cells that may hold a crossing, and the nodes, of each busy block of a row along z; and for all other
// blocks a start value of the distance to the next busy block. A cell's bit is 0 under the condition that mark_row has
// for blocks.
static constexpr auto write_row = [](int row, unsigned long long volume, const wp::vec3i& anchor,
                                     const wp::vec3i& first_block, const wp::vec3i& block_count, auto below, auto above,
                                     const wp::array_t<int>& numbers, wp::array_t<int8_t>& out_distance,
                                     wp::array_t<uint64_t>& out_blocks) {
    typedef decltype(below + below) real;
    auto in = opened(volume, anchor, real());
    int ignored;
    const int row_x = row / block_count[1], row_y = row % block_count[1];
    const bool is_border = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
    const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
    for (int n = 0; n < block_count[2]; ++n) {
        const address at = (address)row * block_count[2] + n;
        const int own = numbers.data[at];
        if (numbers.data[at + 1] == own) {
            out_distance.data[at] = is_border || n == 0 || n == block_count[2] - 1 ? -1 : FARTHEST;
            continue;
        }
        out_distance.data[at] = 0;
        const int z = 8 * (first_block[2] + n);
        unsigned long long* block = (unsigned long long*)out_blocks.data + BLOCK_WORDS * (address)own;
        for (int m = 0; m < 8; ++m) block[8 + m] = find(in, x + 2 * (m & 4), y + 4 * (m & 2), z + 8 * (m & 1), ignored);
        // Two layers of nine lines; bit k of a line is its voxel k along z.
        unsigned over[2][9], under[2][9];
        for (int i = 0; i < 9; ++i) {
            for (int j = 0; j < 9; ++j) {
                unsigned o = 0, u = 0;
                const address* nodes = (const address*)block + 8 + (i >> 3 << 2 | j >> 3 << 1);
                for (int k = 0; k < 8; ++k) {
                    const real v = voxel(in, nodes[0], x + i, y + j, z + k);
                    o |= (v > (real)below ? 1u : 0u) << k;
                    u |= (v < (real)above ? 1u : 0u) << k;
                }
                const real v = voxel(in, nodes[1], x + i, y + j, z + 8);
                over[i & 1][j] = o | (v > (real)below ? 1u : 0u) << 8;
                under[i & 1][j] = u | (v < (real)above ? 1u : 0u) << 8;
            }
            if (i == 0) continue;
            unsigned long long cells = 0;
            for (int j = 0; j < 8; ++j) {
                const unsigned o = over[0][j] & over[0][j + 1] & over[1][j] & over[1][j + 1];
                const unsigned u = under[0][j] & under[0][j + 1] & under[1][j] & under[1][j + 1];
                cells |= (unsigned long long)(~(o & o >> 1 | u & u >> 1) & 255u) << 8 * j;
            }
            block[i - 1] = cells;
        }
    }
};

// A line of blocks along z of spread_distance_kernel, in a loop over bytes that compilers vectorize. Read as unsigned
// bytes, the border's -1 counts as far away.
static constexpr auto spread_line = [](int line, int total, int stride, int count, int length,
                                       const wp::array_t<int8_t>& distance, wp::array_t<int8_t>& out_distance) {
    typedef unsigned char byte;
    const int lines = total / length, part = line / lines, first = (line - part * lines) * length;
    const byte* const in = (const byte*)distance.data + (long long)(part >> 1) * total + first;
    byte* const out = (byte*)out_distance.data + (long long)part * total + first;
    const bool back = part & 1;
    for (int k = 0; k < length; ++k) out[k] = in[k];
    auto see = [](byte* to, const byte* from, int r, int n) {
        for (int k = 0; k < n; ++k) {
            const byte other = from[k] > (byte)r ? from[k] : (byte)r;
            to[k] = to[k] < other ? to[k] : other;
        }
    };
    const int i = first / stride % count, ahead = stride == 1 ? length - 1 : back ? i : count - 1 - i;
    const long long step = back ? -(long long)stride : (long long)stride;
    for (int r = 1; r < FARTHEST && r <= ahead; ++r) {
        if (stride > 1) see(out, in + r * step, r, length);
        else if (back) see(out + r, in, r, length - r);
        else see(out, in + r, r, length - r);
    }
    for (int k = 0; k < length; ++k) out[k] = in[k] == 255 ? in[k] : out[k];
};
