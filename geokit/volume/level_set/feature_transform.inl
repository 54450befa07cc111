// The feature with the nearest foot to voxel (x, y, z) of row t, which is (i, j, k); the first of equal ones.
//
// It is C++ because warp's own indexing takes twice as long. The row of a voxel is in the table of neighbors at
// 9 (x >> 3) + 3 (y >> 3) + (z >> 3) + 13. Lengths are compared by their squares, rounded to float32.
static constexpr auto nearest_of = [](const wp::array_t<int>& nearest, const wp::array_t<uint64_t>& changed,
                                      const wp::array_t<int>& beside, const wp::array_t<wp::vec4d>& feet, float reach,
                                      int inner, int t, int x, int y, int z, double i, double j, double k) -> int {
    const auto square = [](float way) { return way * way; };
    const int* const rows = beside.data + 27 * t;
    const double* const foot = (const double*)feet.data;
    const unsigned long long* const bits = (const unsigned long long*)changed.data;
    const auto length_of = [=](int name) {
        const double* const s = foot + 4 * (name >> 1);
        const double a = i - s[0], b = j - s[1], c = k - s[2];
        const float way = (float)(a * a + b * b + c * c);
        return s[3] > 0.0 ? square((float)s[3] + wp::sqrt(way)) : way;
    };
    int best = nearest.data[(t << 9) + (x << 6) + (y << 3) + z], last = best;
    float shortest = best < 0 ? square(reach) : length_of(best);
    // Within three voxels of the surface a second search changes nothing relevant (docs/design/operations.md).
    if (best >= 0 && shortest < 9.0f) return best;
    for (int u = x - 1; u <= x + 1; ++u)
        for (int v = y - 1; v <= y + 1; ++v) {
            const int side = 9 * (u >> 3) + 3 * (v >> 3) + 13, line = 8 * (v & 7);
            const int middle = rows[side];
            // One bit for each of three voxels along z: whether it has changed.
            unsigned three = middle < 0 ? 0u : (unsigned)(bits[8 * middle + (u & 7)] >> line & 255ull) << 1;
            const int below = rows[side - 1], above = rows[side + 1];
            if (z == 0 && below >= 0) three |= (unsigned)(bits[8 * below + (u & 7)] >> (line + 7) & 1ull);
            if (z == 7 && above >= 0) three |= (unsigned)(bits[8 * above + (u & 7)] >> line & 1ull) << 9;
            three = three >> z & 7u;
            for (int w = z - 1; three != 0u; ++w, three >>= 1) {
                if (!(three & 1u)) continue;
                const int name = nearest.data[(rows[side + (w >> 3)] << 9) + ((u & 7) << 6) + line + (w & 7)];
                if (name == last || name == best || (name & 1) != inner) continue;
                last = name;
                const float length = length_of(name);
                if (length < shortest || (length == shortest && name < best)) {
                    shortest = length;
                    best = name;
                }
            }
        }
    return best;
};
