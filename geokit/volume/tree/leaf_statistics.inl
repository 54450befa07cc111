// Box, flag and extrema of a leaf from its mask and values, and how many of its voxels are active.
//
// Expects core/simd.inl; leaf, begin, tiles, rows, out_buffer, out_boxes, out_extrema, out_count; T is the type of the values.
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
}
#if !defined(__CUDA_ARCH__)
// Eight at a time. What one at a time decides by the order is left to it: which zero, and NaN.
bool is_known = false;
if (columns) {
    typedef T t8 __attribute__((ext_vector_type(8), aligned(4)));
    t8 low = values[64 * first_x + __builtin_ctzll(mask[first_x])], high = low;
    i8 unordered = 0;
    for (int n = 0; n < 64; ++n) {
        const i8 active = __builtin_convertvector(__builtin_bit_cast(b8, out[16 + n]), i8) != 0;
        const t8 value = *(const t8*)(values + 8 * n);
        low = (active & (value < low)) ? value : low;
        high = (active & (value > high)) ? value : high;
        unordered |= active & ~((value <= low) | (value > low));
    }
    least = low[0];
    most = high[0];
    for (int k = 1; k < 8; ++k) {
        least = low[k] < least ? low[k] : least;
        most = high[k] > most ? high[k] : most;
    }
    is_known = !mask_of(unordered != 0) && least != 0 && most != 0;
    if (is_known)
        for (int x = 0; x < 8; ++x) count += __builtin_popcountll(mask[x]);
}
#else
const bool is_known = false;
#endif
for (int x = first_x; x <= last_x && !is_known; ++x)
    for (int b = 0; b < 64; ++b) {
        if (!(mask[x] >> b & 1)) continue;
        const T value = values[64 * x + b];
        least = count == 0 || value < least ? value : least;
        most = count == 0 || value > most ? value : most;
        ++count;
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
