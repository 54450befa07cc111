// Places the triangles of a plane's cells.
//
// Expects cube_planes.inl, cells, start, edges, records, base, first_triangle, turned, faces.

// Planes x and x + 1 of this block and of those above it: index 4 for x + 1, 2 and 1 for the next block along y and z.
const u64* record_of[8];
int base_of[8];
for (int n = 0; n < 8; ++n) {
    const int i = x + (n >> 2), other = refs[4 * (i >> 3) + (n & 3)];
    const int slot = other < 0 ? -1 : cells.slot.data[other], p = slot < 0 ? 0 : 8 * slot + (i & 7);
    record_of[n] = records.data + 3ll * p;
    base_of[n] = base.data[p];
}
auto vertex_on = [&](int bit, int edge) -> int {
    const int axis = edge >> 2, one = edge >> 1 & 1, two = edge & 1;
    const int di = axis == 0 ? 0 : one, j = (bit >> 3) + (axis == 0 ? one : axis == 1 ? 0 : two);
    const int k = (bit & 7) + (axis == 2 ? 0 : two), n = 4 * di + 2 * (j >> 3) + (k >> 3);
    const u64* record = record_of[n];
    const u64 below = (1ull << ((j & 7) << 3 | (k & 7))) - 1;
    int number = base_of[n] + (int)count_bits(record[axis] & below);
    if (axis > 0) number += (int)count_bits(record[0]);
    if (axis > 1) number += (int)count_bits(record[1]);
    return number;
};
int* out = faces.data + 3ll * first_triangle.data[plane];
for (u64 rest = any & ~all; rest; rest &= rest - 1) {
    const int bit = (int)first_bit(rest), code = case_of(c, bit);
    for (int t = start.data[code]; t < start.data[code + 1]; ++t) {
        const int three = edges.data[t];
        if (!is_whole(three, bit)) continue;
        out[0] = vertex_on(bit, three & 15);
        out[turned ? 2 : 1] = vertex_on(bit, three >> 4 & 15);
        out[turned ? 1 : 2] = vertex_on(bit, three >> 8);
        out += 3;
    }
}
