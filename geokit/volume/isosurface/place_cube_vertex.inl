// Places the vertex of one edge from the values at its ends, relative to the isovalue.
//
// Expects block_planes.inl, cube_vertex.inl, cells, plane, bit, axis, low, high, records, base, vertex.

const u64* record = records.data + 3ll * plane;
long long at = base.data[plane] + count_bits(record[axis] & ((1ull << bit) - 1));
for (int before = 0; before < axis; ++before) at += count_bits(record[before]);
const wp::vec_t<3, int>& first = cells.origin.data[cells.crossed.data[plane >> 3]];
vertex.data[at] = point_on(first, plane & 7, bit, axis, (float)low, (float)high);
