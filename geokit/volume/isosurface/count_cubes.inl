// Counts the vertices and triangles of a plane, and writes bit masks of its crossed edges.
//
// Expects cube_planes.inl, start, edges, plane, records. Returns the counts and a flag, packed into one word.

u64* record = records.data + 3ll * plane;
int vertices = 0, triangles = 0;
for (int axis = 0; axis < 3; ++axis) {
    const int n = 4 >> axis;
    record[axis] = (c[0] ^ c[n]) & (a[0] | a[n]);
    vertices += (int)count_bits(record[axis]);
}
for (u64 rest = any & ~all; rest; rest &= rest - 1) {
    const int bit = (int)first_bit(rest), code = case_of(c, bit);
    if (dead >> bit & 1) {
        for (int t = start.data[code]; t < start.data[code + 1]; ++t) triangles += is_whole(edges.data[t], bit);
    } else {
        triangles += start.data[code + 1] - start.data[code];
    }
}
return vertices | triangles << 16 | (dead ? 1 << 30 : 0);
