// Places the vertices of one cell from the values at its corners, relative to the isovalue.
//
// Expects nets.inl, net_vertex.inl, cells, plane, bit, value, vertex, RECORD.

const int block = cells.crossed.data[plane >> 3];
const wp::vec_t<3, int>& first = cells.origin.data[block];
u64 c[8];
cell_corners(block, plane & 7, inside_plane, c);
const int code = case_of(c, bit);
float f[8];
for (int n = 0; n < 8; ++n) f[n] = (float)value[n];
const u64* record = records.data + (long long)RECORD * plane;
const u64 below = (1ull << bit) - 1;
long long start = base.data[plane];
for (int n = 0; n < RECORD; ++n) start += count_bits(record[n] & below);
const int at[3] = {first[0] + (plane & 7), first[1] + (bit >> 3), first[2] + (bit & 7)};
place(word_of(code, plane, bit), nets.sums.data[code], f, at, vertex.data + start);
