// Box, flag and extrema of a leaf from its mask and values, and how many of its voxels are active.
//
// Expects leaf, begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count; T is the type of the values.
//
// Boxes are first and last voxel; an empty one starts at the leaf.

unsigned char* out = out_buffer.data + begin + 2144ll * leaf;
const unsigned long long* mask = (const unsigned long long*)(out + 16);
const T* values = (const T*)(out + 96);
unsigned long long columns = 0;
int first_x = 8, last_x = -1, count = 0;
T least = 0, most = 0;
for (int x = 0; x < 8; ++x) {
    if (!mask[x]) continue;
    columns |= mask[x];
    first_x = first_x < x ? first_x : x;
    last_x = x;
    for (int b = 0; b < 64; ++b) {
        if (!(mask[x] >> b & 1)) continue;
        const T value = values[64 * x + b];
        least = count == 0 || value < least ? value : least;
        most = count == 0 || value > most ? value : most;
        ++count;
    }
}
int first_y = 8, last_y = -1;
unsigned line = 0;
for (int y = 0; y < 8; ++y) {
    const unsigned bits = (unsigned)(columns >> (8 * y)) & 0xff;
    if (!bits) continue;
    line |= bits;
    first_y = first_y < y ? first_y : y;
    last_y = y;
}
int first_z = 8, last_z = -1;
for (int z = 0; z < 8; ++z)
    if (line >> z & 1) {
        first_z = first_z < z ? first_z : z;
        last_z = z;
    }
const wp::vec_t<3, int> tile = tiles.data[rows.data[leaf]];
const int corner[3] = {8 * tile[0], 8 * tile[1], 8 * tile[2]};
const int low[3] = {first_x, first_y, first_z}, high[3] = {last_x, last_y, last_z};
int* box = out_boxes.data + 6ll * leaf;
for (int k = 0; k < 3; ++k) {
    ((int*)out)[k] = count ? corner[k] + low[k] : corner[k];
    out[12 + k] = count ? (unsigned char)(high[k] - low[k]) : 0;
    box[k] = count ? corner[k] + low[k] : 2147483647;
    box[3 + k] = count ? corner[k] + high[k] : -2147483647 - 1;
}
out[15] = count ? 2 : 0;
((T*)(out + 80))[0] = ((T*)out_extrema.data)[2ll * leaf] = least;
((T*)(out + 80))[1] = ((T*)out_extrema.data)[2ll * leaf + 1] = most;
out_count.data[leaf] = count;
