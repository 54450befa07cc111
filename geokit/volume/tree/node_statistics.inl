// A node's box, flag and extrema from those of its children, or of as many parts of them as there are.
//
// Expects merge_statistics.inl, node, level, parts, first_child, first_leaf, boxes, extrema, tiles, rows,
// out_buffer, out_boxes, out_extrema; T is the type of the values.

unsigned char* out = out_buffer.data + level.begin + node * level.size;
const wp::vec_t<3, int> tile = tiles.data[rows.data[first_leaf.data[node]]];
for (int k = 0; k < 6; ++k) {
    out_boxes.data[6ll * node + k] = box[k];
    // Readers take a node's origin from its box: an empty one starts there too, and ends before it.
    ((int*)out)[k] = some || k >= 3 ? box[k] : (8 * tile[k]) & ~(level.span - 1);
}
*(unsigned long long*)(out + 24) = some ? 2 : 0;
((T*)(out + level.statistics))[0] = ((T*)out_extrema.data)[2ll * node] = least;
((T*)(out + level.statistics))[1] = ((T*)out_extrema.data)[2ll * node + 1] = most;
