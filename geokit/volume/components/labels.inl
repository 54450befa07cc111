// Components within rows of 8^3 cells: cell (x, y, z) of a row is bit 8 y + z of its word x.

// Links every set cell of a row to the first set cell that it is connected to. Sets the bits of the first cells in
// out_first, and writes at them how many cells their components have.
//
// It is C++ because union-find needs a local array. A neighbor is skipped where it and the cell before it on their
// lines along z are set: the line that both ends belong to has joined them already.
static constexpr auto label_row = [](int row, const wp::array_t<uint64_t>& words, wp::array_t<int>& out_links,
                                     wp::array_t<uint64_t>& out_first, wp::array_t<int16_t>& out_size) {
    const unsigned long long* const plane = (const unsigned long long*)words.data + 8 * row;
    int* const out = out_links.data + 512 * row;
    short* const size = out_size.data + 512 * row;
    #if defined(__CUDA_ARCH__)
    const auto lowest = [](unsigned long long mask) { return __ffsll((long long)mask) - 1; };
    #else
    const auto lowest = [](unsigned long long mask) { return __builtin_ctzll(mask); };
    #endif
    short up[512];
    const auto root = [&up](int n) {
        while (up[n] != n) n = up[n] = up[up[n]];
        return n;
    };
    const auto join = [&up, &root](int a, int b) {
        a = root(a);
        b = root(b);
        up[a > b ? a : b] = (short)(a < b ? a : b);
    };
    const unsigned long long not_first = 0xfefefefefefefefeull;  // cells with another one before them on their line
    unsigned long long behind = 0ull;
    for (int x = 0; x < 8; ++x) {
        const unsigned long long here = plane[x], both = here & behind;
        const unsigned long long along = here & here << 1 & not_first;
        const unsigned long long by_y = here & here << 8 & ~(along & here << 9), by_x = both & ~(both << 1 & not_first);
        for (unsigned long long rest = here; rest; rest &= rest - 1) {
            const int n = lowest(rest), at = 64 * x + n;
            up[at] = (short)(along >> n & 1ull ? up[at - 1] : at);
            if (by_y >> n & 1ull) join(at, at - 8);
            if (by_x >> n & 1ull) join(at, at - 64);
        }
        behind = here;
    }
    for (int x = 0; x < 8; ++x) {
        unsigned long long first = 0ull;
        for (unsigned long long rest = plane[x]; rest; rest &= rest - 1) {
            const int n = lowest(rest), at = 64 * x + n;
            // Links lead to lower cells, whose own links are roots already.
            const int top = up[at] = up[up[at]];
            out[at] = 512 * row + top;
            if (top == at) {
                first |= 1ull << n;
                size[at] = 0;
            }
            ++size[top];
        }
        ((unsigned long long*)out_first.data)[8 * row + x] = first;
    }
};

// Replaces the links of a row by the names of their components, 0 for cells that are not set. The first cell of a
// component within its row holds -1 minus the number of the component; the others link to it, so it has its name
// before they read it.
static constexpr auto name_row = [](int row, const wp::array_t<uint64_t>& words, const wp::array_t<int>& names,
                                    wp::array_t<int>& out_links) {
    const unsigned long long* const plane = (const unsigned long long*)words.data + 8 * row;
    int* const link = out_links.data;
    for (int x = 0; x < 8; ++x) {
        int* const out = link + 512 * row + 64 * x;
        for (int n = 0; n < 64; ++n) {
            if (!(plane[x] >> n & 1ull)) out[n] = 0;
            else out[n] = out[n] < 0 ? names.data[-1 - out[n]] : link[out[n]];
        }
    }
};
