// The sheets of the surface in a cell: see surface_nets_cases_kernels.
//
// A word of loop_table is for a case, or for a case with its problem face joined. It has two bits for the loop of each
// edge, the number of loops, and the problem face + 1.
#pragma once
#include "volume/isosurface/blocks.inl"

static constexpr auto word_of = [](const auto& table, const auto& flips, int code, int plane, int bit) -> unsigned {
    return table.data[code + (int)(flips.data[plane] >> bit & 1ull) * 256];
};
static constexpr auto loop_count = [](unsigned word) { return (int)(word >> 24 & 7u); };

struct PlaneCount {
    int vertices, quads;
    bool has_problem, is_dead;
};
// Counts the vertices and quads of a plane, and writes bit masks of its cells by number of sheets.
static constexpr auto count_plane = [](const Cells& cells, const wp::array_t<uint32_t>& table,
                                       const wp::array_t<uint64_t>& flips, int plane, wp::array_t<uint64_t>& records,
                                       wp::array_t<uint64_t>& problems) -> PlaneCount {
    const int block = cells.crossed.data[plane >> 3], x = plane & 7;
    u64* record = records.data + (long long)RECORD * plane;
    u64 c[8];
    cell_corners(cells, block, x, inside_plane, c);
    u64 any = 0, all = ~0ull;
    for (int n = 0; n < 8; ++n) {
        any |= c[n];
        all &= c[n];
    }
    u64 crossed = any & ~all;
    for (int n = 0; n < RECORD; ++n) record[n] = 0;
    problems.data[plane] = 0;
    if (!crossed) return {};
    u64 a[8], live = 0;
    cell_corners(cells, block, x, active_plane, a);
    for (int n = 0; n < 8; ++n) live |= a[n];
    crossed &= live;
    const int quads = (int)(count_bits((c[3] ^ c[7]) & (a[3] | a[7])) + count_bits((c[5] ^ c[7]) & (a[5] | a[7]))
                            + count_bits((c[6] ^ c[7]) & (a[6] | a[7])));
    record[0] = crossed;
    u64 problem = 0;
    for (u64 rest = crossed; rest; rest &= rest - 1) {
        const int bit = (int)first_bit(rest);
        const unsigned word = word_of(table, flips, case_of(c, bit), plane, bit);
        for (int n = 1; n < loop_count(word); ++n) record[n] |= 1ull << bit;
        if (word >> 27) problem |= 1ull << bit;
    }
    problems.data[plane] = problem;
    int vertices = 0;
    for (int n = 0; n < RECORD; ++n) vertices += (int)count_bits(record[n]);
    return {vertices, quads, problem != 0, (dead_edges(c, a) & crossed) != 0};
};
static constexpr auto count_planes = [](int item, int span, const Cells& cells, const wp::array_t<uint32_t>& table,
                                        wp::array_t<uint64_t>& out_flips, wp::array_t<uint64_t>& out_records,
                                        wp::array_t<uint64_t>& out_problems, wp::array_t<int>& out_vertices,
                                        wp::array_t<int>& out_quads, wp::array_t<int>& out_flags) {
    for (int plane = span * item; plane < span * (item + 1); ++plane) {
        out_flips.data[plane] = 0;
        const PlaneCount found = count_plane(cells, table, out_flips, plane, out_records, out_problems);
        out_vertices.data[plane] = found.vertices;
        out_quads.data[plane] = found.quads;
        // All threads that write here write the same value.
        if (found.has_problem) out_flags.data[0] = 1;
        if (found.is_dead) out_flags.data[1] = 1;
    }
};
static constexpr auto count_joined_planes =
    [](int item, int span, const Cells& cells, const wp::array_t<uint32_t>& table, const wp::array_t<uint64_t>& flips,
       wp::array_t<uint64_t>& problems, wp::array_t<uint64_t>& out_records, wp::array_t<int>& out_vertices) {
        for (int plane = span * item; plane < span * (item + 1); ++plane)
            if (flips.data[plane])
                out_vertices.data[plane] = count_plane(cells, table, flips, plane, out_records, problems).vertices;
    };

// The case of a cell: the bit mask of its inside corners.
static constexpr auto case_at = [](const auto& cells, const auto& table, const auto& flips, int plane, int bit) -> int {
    u64 c[8];
    cell_corners(cells, cells.crossed.data[plane >> 3], plane & 7, inside_plane, c);
    return case_of(c, bit);
};
