// Writes the local box of a slot's triangle to its column in a block of eight slots; an empty slot's box is inverted.
//
// Expects local_box.inl; tree, slot, out_boxes.
float* row = out_boxes.data + 48 * (slot / 8) + slot % 8;
if (tree.slot_triangle.data[slot] < 0) {
    for (int k = 0; k < 3; ++k) {
        row[8 * k] = INFINITY;
        row[24 + 8 * k] = -INFINITY;
    }
    return;
}
double lower[3], upper[3];
const wp::vec_t<3, wp::float64>* p = tree.corners.data + 3 * slot;
for (int k = 0; k < 3; ++k) {
    lower[k] = wp::min(wp::min(p[0][k], p[1][k]), p[2][k]);
    upper[k] = wp::max(wp::max(p[0][k], p[1][k]), p[2][k]);
}
float low[3], high[3];
local_box(tree, lower, upper, low, high);
for (int k = 0; k < 3; ++k) {
    row[8 * k] = low[k];
    row[24 + 8 * k] = high[k];
}
