// A plane of 64 cells: which of their corners are inside, and which of their edges have an active end.
//
// Expects block_planes.inl, cells, plane. Defines block, x, refs, c, a, any, all, dead and is_whole(edges, bit):
// whether all three edges of a triangle have an active end.

const int block = cells.crossed.data[plane >> 3], x = plane & 7;
const int* refs = cells.refs.data + 8ll * block;
u64 c[8], a[8];
corners(refs, x, inside_plane, c);
corners(refs, x + 1, inside_plane, c + 4);
corners(refs, x, active_plane, a);
corners(refs, x + 1, active_plane, a + 4);
u64 any = 0, all = ~0ull, dead = 0;
for (int n = 0; n < 8; ++n) {
    any |= c[n];
    all &= c[n];
}
for (int step = 4; step; step >>= 1)
    for (int n = 0; n < 8; ++n)
        if (!(n & step)) dead |= (c[n] ^ c[n + step]) & ~(a[n] | a[n + step]);
// Whether an edge of the cell at `bit` has an active end.
auto is_live = [&](int edge, int bit) -> bool {
    const int axis = edge >> 2, high = axis == 0 ? 2 : 4, low = axis == 2 ? 2 : 1;
    const int n = (edge >> 1 & 1) * high + (edge & 1) * low;
    return ((a[n] | a[n + (4 >> axis)]) >> bit & 1) != 0;
};
auto is_whole = [&](int edges, int bit) -> bool {
    return !(dead >> bit & 1)
           || (is_live(edges & 15, bit) && is_live(edges >> 4 & 15, bit) && is_live(edges >> 8, bit));
};
