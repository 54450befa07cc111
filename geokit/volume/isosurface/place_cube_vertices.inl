// Places the vertices of a plane's edges.
//
// Expects block_planes.inl, cube_vertex.inl, cells, plane, records, base, vertex. Returns false if some are left
// because an end lies in a tile.

const int block = cells.crossed.data[plane >> 3], x = plane & 7;
const u64* record = records.data + 3ll * plane;
const wp::vec_t<3, int>& first = cells.origin.data[block];
// The leaf of the block, and the leaves beyond its upper faces along x, y and z, if they exist.
const float* leaf[4];
for (int d = 0; d < 4; ++d) {
    const int ref = cells.refs.data[8ll * block + (d ? 4 >> (d - 1) : 0)];
    const bool is_leaf = ref >= 0 && ref < cells.leaf_count;
    leaf[d] = is_leaf ? (const float*)(cells.values + cells.stride * (u64)ref) : (const float*)0;
}
wp::vec_t<3, double>* out = vertex.data + base.data[plane];
bool is_complete = true;
for (int axis = 0; axis < 3; ++axis) {
    for (u64 rest = record[axis]; rest; rest &= rest - 1, ++out) {
        const int bit = (int)first_bit(rest), n = 64 * x + bit, step = 64 >> 3 * axis;
        const int along = axis == 0 ? x : axis == 1 ? bit >> 3 : bit & 7;
        const float* end = along < 7 ? leaf[0] : leaf[axis + 1];
        if (!leaf[0] || !end) {
            is_complete = false;
            continue;
        }
        const float f = (float)((double)leaf[0][n] - cells.isovalue);
        const float g = (float)((double)end[along < 7 ? n + step : n - 7 * step] - cells.isovalue);
        *out = point_on(first, x, bit, axis, f, g);
    }
}
return is_complete;
