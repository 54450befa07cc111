// Counts the vertices and quads of a plane, and writes bit masks of its cells by number of sheets.
//
// Expects sheet_cases.inl, cells, plane, records, problems, RECORD, QUADS_SHIFT. Returns the counts and flags, packed
// into one word.

const int block = cells.crossed.data[plane >> 3], x = plane & 7;
u64* record = records.data + (long long)RECORD * plane;
u64 c[8];
cell_corners(block, x, inside_plane, c);
u64 any = 0, all = ~0ull;
for (int n = 0; n < 8; ++n) {
    any |= c[n];
    all &= c[n];
}
u64 crossed = any & ~all;
for (int n = 0; n < RECORD; ++n) record[n] = 0;
problems.data[plane] = 0;
if (!crossed) return 0;
u64 a[8], live = 0, dead = 0;
cell_corners(block, x, active_plane, a);
for (int n = 0; n < 8; ++n) live |= a[n];
crossed &= live;
for (int step = 4; step; step >>= 1)
    for (int n = 0; n < 8; ++n)
        if (!(n & step)) dead |= (c[n] ^ c[n + step]) & ~(a[n] | a[n + step]);
const int quads = (int)(count_bits((c[3] ^ c[7]) & (a[3] | a[7])) + count_bits((c[5] ^ c[7]) & (a[5] | a[7]))
                        + count_bits((c[6] ^ c[7]) & (a[6] | a[7])));
record[0] = crossed;
u64 problem = 0;
for (u64 rest = crossed; rest; rest &= rest - 1) {
    const int bit = (int)first_bit(rest);
    const unsigned word = word_of(case_of(c, bit), plane, bit);
    for (int n = 1; n < loop_count(word); ++n) record[n] |= 1ull << bit;
    if (word >> 27) problem |= 1ull << bit;
}
problems.data[plane] = problem;
int vertices = 0;
for (int n = 0; n < RECORD; ++n) vertices += (int)count_bits(record[n]);
return vertices | quads << QUADS_SHIFT | (dead & crossed ? 1 << 29 : 0) | (problem ? 1 << 30 : 0);
