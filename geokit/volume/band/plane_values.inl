// Values of a plane of 64 voxels, from distances and the bit mask of the negative ones.
//
// Expects leaf, x, rows, distance, inside (may be empty), exterior, interior. Defines d, within and values.
const float* d = distance.data + 512ll * rows.data[leaf] + 64 * x;
const unsigned long long within = inside.data ? ((const unsigned long long*)inside.data)[8ll * leaf + x] : 0;
float values[64];
for (int b = 0; b < 64; ++b) {
    const float value = ((within >> b & 1) ? -d[b] : d[b]);
    values[b] = value < exterior ? (value > interior ? value : interior) : exterior;
}
