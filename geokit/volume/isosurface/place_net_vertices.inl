// Places the vertices of a plane's cells.
//
// Expects nets.inl, net_vertex.inl, cells, plane, vertex, RECORD. Returns a bit mask of the cells that are
// left because a corner lies in a tile.

const int block = cells.crossed.data[plane >> 3], x = plane & 7;
const u64* record = records.data + (long long)RECORD * plane;
if (!record[0]) return 0ull;
const int* refs = cells.refs.data + 8ll * block;
const wp::vec_t<3, int>& first = cells.origin.data[block];
u64 c[8], left = 0;
cell_corners(block, x, inside_plane, c);
// The leaf of each of the eight blocks, if it exists.
const float* leaf[8];
for (int d = 0; d < 8; ++d) {
    const bool is_leaf = refs[d] >= 0 && refs[d] < cells.leaf_count;
    leaf[d] = is_leaf ? (const float*)(cells.values + cells.stride * (u64)refs[d]) : (const float*)0;
}
wp::vec_t<3, double>* out = vertex.data + base.data[plane];
for (u64 rest = record[0]; rest; rest &= rest - 1) {
    const int bit = (int)first_bit(rest), y = bit >> 3, z = bit & 7;
    const int code = case_of(c, bit);
    const unsigned word = word_of(code, plane, bit);
    alignas(32) float f[8];
    bool known = true;
    if (x < 7 && y < 7 && z < 7 && leaf[0]) {
        const float* v = leaf[0] + 64 * x + bit;
        #pragma unroll
        for (int n = 0; n < 8; ++n) {
            f[n] = (float)((double)v[64 * (n >> 2) + 8 * (n >> 1 & 1) + (n & 1)] - cells.isovalue);
        }
    } else {
        for (int n = 0; n < 8; ++n) {
            const int i = x + (n >> 2), j = y + (n >> 1 & 1), k = z + (n & 1);
            const float* v = leaf[4 * (i >> 3) + 2 * (j >> 3) + (k >> 3)];
            known = known && v;
            f[n] = v ? (float)((double)v[64 * (i & 7) + 8 * (j & 7) + (k & 7)] - cells.isovalue) : 0.f;
        }
    }
    const int at[3] = {first[0] + x, first[1] + y, first[2] + z};
    if (known) place(word, nets.sums.data[code], f, at, out);
    else left |= 1ull << bit;
    out += loop_count(word);
}
return left;
