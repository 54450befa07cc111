// Places two triangles for each crossed edge that a plane's cells own; quads are split along the shorter diagonal.
//
// Expects nets.inl, sheet_cases.inl, cells, plane, first_quad, turned, vertex, faces, RECORD.

const int block = cells.crossed.data[plane >> 3], x = plane & 7;
if (!records.data[(long long)RECORD * plane]) return;
const int* refs = cells.refs.data + 8ll * block;
u64 c[8], a[8];
cell_corners(block, x, inside_plane, c);
cell_corners(block, x, active_plane, a);
// Planes x and x + 1 of this block and of those above it: index 4 for x + 1, 2 and 1 for the next block along y and z.
const u64* record_of[8];
int plane_of[8];
for (int n = 0; n < 8; ++n) {
    const int i = x + (n >> 2), other = refs[4 * (i >> 3) + (n & 3)];
    const int slot = other < 0 ? -1 : cells.slot.data[other];
    plane_of[n] = 8 * slot + (i & 7);
    record_of[n] = records.data + (long long)RECORD * (slot < 0 ? 0 : plane_of[n]);
}
// The vertex of the sheet that crosses an edge of the cell (x + di, j, k), counted from this block; indices up to 8.
auto vertex_at = [&](int di, int j, int k, int edge) -> int {
    const int n = 4 * di + 2 * (j >> 3) + (k >> 3), p = plane_of[n], bit = (j & 7) << 3 | (k & 7);
    const u64* record = record_of[n];
    const u64 below = (1ull << bit) - 1;
    int number = base.data[p] + (int)count_bits(record[0] & below);
    if (record[1]) {
        for (int m = 1; m < RECORD; ++m) number += (int)count_bits(record[m] & below);
        if (record[1] >> bit & 1) {
            u64 d[8];
            cell_corners(cells.crossed.data[p >> 3], p & 7, inside_plane, d);
            number += (int)(word_of(case_of(d, bit), p, bit) >> 2 * edge & 3u);
        }
    }
    return number;
};
int* out = faces.data + 6ll * first_quad.data[plane];
auto distance = [&](int p, int q) {
    const wp::vec_t<3, double> e = vertex.data[p] - vertex.data[q];
    return e[0] * e[0] + e[1] * e[1] + e[2] * e[2];
};
const u64 crossed[3] = {(c[3] ^ c[7]) & (a[3] | a[7]), (c[5] ^ c[7]) & (a[5] | a[7]), (c[6] ^ c[7]) & (a[6] | a[7])};
for (u64 rest = crossed[0] | crossed[1] | crossed[2]; rest; rest &= rest - 1) {
    const int bit = (int)first_bit(rest), y = bit >> 3, z = bit & 7;
    for (int axis = 0; axis < 3; ++axis) {
        if (!(crossed[axis] >> bit & 1)) continue;
        // Corners run counter-clockwise about the axis, seen from its upper end.
        int q[4];
        q[0] = vertex_at(0, y, z, 3 + 4 * axis);
        if (axis == 0) {
            q[1] = vertex_at(0, y + 1, z, 1);
            q[2] = vertex_at(0, y + 1, z + 1, 0);
            q[3] = vertex_at(0, y, z + 1, 2);
        } else if (axis == 1) {
            q[1] = vertex_at(0, y, z + 1, 6);
            q[2] = vertex_at(1, y, z + 1, 4);
            q[3] = vertex_at(1, y, z, 5);
        } else {
            q[1] = vertex_at(1, y, z, 9);
            q[2] = vertex_at(1, y + 1, z, 8);
            q[3] = vertex_at(0, y + 1, z, 10);
        }
        const bool is_outward = (c[7 - (4 >> axis)] >> bit & 1) != 0;
        if (is_outward == (turned != 0)) {
            const int swap = q[1];
            q[1] = q[3];
            q[3] = swap;
        }
        // Ties keep the first diagonal.
        if (distance(q[0], q[2]) <= distance(q[1], q[3])) {
            out[0] = q[0];
            out[1] = q[1];
            out[2] = q[2];
            out[3] = q[0];
            out[4] = q[2];
            out[5] = q[3];
        } else {
            out[0] = q[0];
            out[1] = q[1];
            out[2] = q[3];
            out[3] = q[1];
            out[4] = q[2];
            out[5] = q[3];
        }
        out += 6;
    }
}
