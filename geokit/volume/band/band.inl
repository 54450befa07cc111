// Planes of 64 voxels of a band's leaves: see band_kernels.

// The values of a plane, and the bit mask of its active voxels.
struct Plane {
    float values[64];
    unsigned long long active;
};
// From distances and the bit mask of the negative ones, which may be empty.
static constexpr auto plane_of = [](int item, const wp::array_t<int>& rows, const wp::array_t<float>& distance,
                                    const wp::array_t<uint64_t>& inside, float exterior, float interior) -> Plane {
    const float* d = distance.data + 512ll * rows.data[item >> 3] + 64 * (item & 7);
    const unsigned long long within = inside.data ? inside.data[item] : 0;
    Plane plane;
    for (int b = 0; b < 64; ++b) {
        const float value = ((within >> b & 1) ? -d[b] : d[b]);
        plane.values[b] = value < exterior ? (value > interior ? value : interior) : exterior;
    }
    plane.active = 0;
    for (int b = 0; b < 64; ++b)
        plane.active |= (unsigned long long)(plane.values[b] < exterior && plane.values[b] > interior) << b;
    return plane;
};

static constexpr auto plane_bits = [](int item, const wp::array_t<int>& rows, const wp::array_t<float>& distance,
                                      const wp::array_t<uint64_t>& inside, float exterior, float interior,
                                      wp::array_t<uint64_t>& out_active, wp::array_t<uint64_t>& out_negative,
                                      wp::array_t<int>& out_some) {
    const Plane plane = plane_of(item, rows, distance, inside, exterior, interior);
    unsigned long long negative = 0;
    for (int b = 0; b < 64; ++b) negative |= (unsigned long long)(plane.values[b] < 0.f) << b;
    out_active.data[item] = plane.active;
    out_negative.data[item] = negative;
    if (negative) out_some.data[0] = 1;
};

static constexpr auto write_plane = [](int item, int64_t begin, const wp::array_t<int>& rows,
                                       const wp::array_t<float>& distance, const wp::array_t<uint64_t>& inside,
                                       float exterior, float interior, wp::array_t<uint8_t>& out_buffer) {
    const Plane plane = plane_of(item, rows, distance, inside, exterior, interior);
    unsigned char* out = out_buffer.data + begin + 2144ll * (item >> 3);
    const int x = item & 7;
    for (int b = 0; b < 64; ++b) ((float*)(out + 96))[64 * x + b] = plane.values[b];
    ((unsigned long long*)(out + 16))[x] = plane.active;
};
