// Box, flag and extrema of the nodes of a grid, whose values have the type of the extrema: see device_writer_kernels.
#include "core/simd.inl"

// Box, flag and extrema of a leaf from its mask and values, and how many of its voxels are active. Boxes are first and
// last voxel; an empty one starts at the leaf.
static constexpr auto measure_leaf = [](int leaf, long long begin, const wp::array_t<wp::vec3i>& tiles,
                                        const wp::array_t<int>& rows, wp::array_t<uint8_t>& out_buffer,
                                        wp::array_t<int>& out_boxes, auto& out_extrema, wp::array_t<int>& out_count) {
    typedef decltype(*out_extrema.data + *out_extrema.data) T;
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
    const wp::vec3i tile = tiles.data[rows.data[leaf]];
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
    ((T*)(out + 80))[0] = out_extrema.data[2ll * leaf] = least;
    ((T*)(out + 80))[1] = out_extrema.data[2ll * leaf + 1] = most;
    out_count.data[leaf] = count;
};

// Box and extrema of the children `child` to `end` - 1; whether any of them has an active voxel.
static constexpr auto merge = [](int child, int end, const wp::array_t<int>& boxes, const auto& extrema, int* box,
                                 auto& least, auto& most) -> bool {
    for (int k = 0; k < 3; ++k) {
        box[k] = 2147483647;
        box[3 + k] = -2147483647 - 1;
    }
    least = most = 0;
    bool some = false;
    for (; child < end; ++child) {
        const int* of = boxes.data + 6ll * child;
        if (of[0] > of[3]) continue;
        const auto low = extrema.data[2ll * child], high = extrema.data[2ll * child + 1];
        least = !some || low < least ? low : least;
        most = !some || high > most ? high : most;
        some = true;
        for (int k = 0; k < 3; ++k) {
            box[k] = of[k] < box[k] ? of[k] : box[k];
            box[3 + k] = of[3 + k] > box[3 + k] ? of[3 + k] : box[3 + k];
        }
    }
    return some;
};

// Box and extrema of a part of a node's children, which stand from first_child[node] on.
static constexpr auto measure_part = [](int item, int parts, const wp::array_t<int>& first_child,
                                        const wp::array_t<int>& boxes, const auto& extrema, wp::array_t<int>& out_boxes,
                                        auto& out_extrema) {
    typedef decltype(*out_extrema.data + *out_extrema.data) T;
    const int node = item / parts, part = item % parts;
    const int begin = first_child.data[node], count = first_child.data[node + 1] - begin;
    const int child = begin + (int)((long long)count * part / parts);
    const int end = begin + (int)((long long)count * (part + 1) / parts);
    int box[6];
    T least, most;
    merge(child, end, boxes, extrema, box, least, most);
    for (int k = 0; k < 6; ++k) out_boxes.data[6ll * item + k] = box[k];
    out_extrema.data[2ll * item] = least;
    out_extrema.data[2ll * item + 1] = most;
};

// A node's box, flag and extrema from those of its children, or of as many parts of them as there are.
static constexpr auto measure_node =
    [](int node, const auto& level, int parts, const wp::array_t<int>& first_child, const wp::array_t<int>& first_leaf,
       const wp::array_t<int>& boxes, const auto& extrema, const wp::array_t<wp::vec3i>& tiles,
       const wp::array_t<int>& rows, wp::array_t<uint8_t>& out_buffer, wp::array_t<int>& out_boxes, auto& out_extrema) {
        typedef decltype(*out_extrema.data + *out_extrema.data) T;
        const int child = parts ? node * parts : first_child.data[node];
        const int end = parts ? child + parts : first_child.data[node + 1];
        int box[6];
        T least, most;
        const bool some = merge(child, end, boxes, extrema, box, least, most);
        unsigned char* out = out_buffer.data + level.begin + node * level.size;
        const wp::vec3i tile = tiles.data[rows.data[first_leaf.data[node]]];
        for (int k = 0; k < 6; ++k) {
            out_boxes.data[6ll * node + k] = box[k];
            // Readers take a node's origin from its box: an empty one starts there too, and ends before it.
            ((int*)out)[k] = some || k >= 3 ? box[k] : (8 * tile[k]) & ~(level.span - 1);
        }
        *(unsigned long long*)(out + 24) = some ? 2 : 0;
        ((T*)(out + level.statistics))[0] = out_extrema.data[2ll * node] = least;
        ((T*)(out + level.statistics))[1] = out_extrema.data[2ll * node + 1] = most;
    };
