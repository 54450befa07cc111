"""C++ of the trilinear interpolant, for fields of one level (trilinear_table_kernels) and of many (sample_kernels).

Both put their functions together from these pieces, so their sums are the same to the last bit. A piece names what it
reads: ``table`` and its ``top`` and ``slots``, the index coordinates (x, y, z) of voxels in the table's box, and in
pieces for a group of queries an array of each.
"""

# mypy: ignore-errors
import warp as wp

__all__ = [
    "ENTRY_OF",
    "GRADIENT_SUM",
    "GROUP",
    "MATRIX",
    "SINGLE_CELL",
    "VALUE_SUM",
    "box_of",
    "group_cells",
    "group_positions",
    "group_steps",
    "group_sums",
    "overloads",
    "slots_of",
    "tree_of",
    "voxel_entry",
]

# Before loops that read what lies apart: compilers make gather instructions of them, which take several times as long
# as the loads on processors whose microcode guards them (Intel's before 2023).
ONE_BY_ONE = "#pragma clang loop vectorize(disable)"

# Queries of a thread on a CPU: as many bits as the mask of those that the table does not answer.
GROUP = wp.constant(64)

MATRIX = """
    const double m00 = to_index.data[0][0], m01 = to_index.data[0][1], m02 = to_index.data[0][2];
    const double m10 = to_index.data[1][0], m11 = to_index.data[1][1], m12 = to_index.data[1][2];
    const double m20 = to_index.data[2][0], m21 = to_index.data[2][1], m22 = to_index.data[2][2];
"""

VALUE_SUM = """
    const double low_low = c0 + (c1 - c0) * z, low_high = c2 + (c3 - c2) * z;
    const double high_low = c4 + (c5 - c4) * z, high_high = c6 + (c7 - c6) * z;
    const double low = low_low + (low_high - low_low) * y, high = high_low + (high_high - high_low) * y;
    const double value = low + (high - low) * x;
"""
# Differences before averages, as in linear_differences.
GRADIENT_SUM = """
    const double i_low = (c4 - c0) + ((c5 - c1) - (c4 - c0)) * z, i_high = (c6 - c2) + ((c7 - c3) - (c6 - c2)) * z;
    const double j_low = (c2 - c0) + ((c3 - c1) - (c2 - c0)) * z, j_high = (c6 - c4) + ((c7 - c5) - (c6 - c4)) * z;
    const double k_low = (c1 - c0) + ((c3 - c2) - (c1 - c0)) * y, k_high = (c5 - c4) + ((c7 - c6) - (c5 - c4)) * y;
    const double di = i_low + (i_high - i_low) * y;
    const double dj = j_low + (j_high - j_low) * x;
    const double dk = k_low + (k_high - k_low) * x;
    const double g0 = di * m00 + dj * m10 + dk * m20;
    const double g1 = di * m01 + dj * m11 + dk * m21;
    const double g2 = di * m02 + dj * m12 + dk * m22;
"""


def tree_of(table):
    """What a look-up in a table reads."""
    return f"""
    const int* const top = {table}.top.data;
    const int* const slots = {table}.slots.data;
    const int size_y = {table}.size[1], size_z = {table}.size[2];
"""


def box_of(table):
    """The box of a table: its first voxel, and the last from which on there is no cell."""
    return f"""
    const int lower_x = {table}.lower[0], lower_y = {table}.lower[1], lower_z = {table}.lower[2];
    const int last_x = {table}.size[0] * 128 - 2, last_y = {table}.size[1] * 128 - 2;
    const int last_z = {table}.size[2] * 128 - 2;
"""


def slots_of(x, y, z):
    """The upper node of a voxel in the table, and its leaf's slot there."""
    top = f"(({x} >> 7) * size_y + ({y} >> 7)) * size_z + ({z} >> 7)"
    return top, f"(({x} >> 3) & 15) << 8 | (({y} >> 3) & 15) << 4 | (({z} >> 3) & 15)"


def voxel_entry(x, y, z):
    """The ``entry`` of a voxel: at or above 0 that of its leaf, below 0 the complement of a tile's place."""
    top, slot = slots_of(x, y, z)
    return f"""
    const int start = top[{top}];
    const int entry = start < 0 ? start : slots[start + ({slot})];
"""


ENTRY_OF = f"""
    const auto entry_of = [&](int f, int g, int h) {{
        {voxel_entry("f", "g", "h")}
        return entry;
    }};
"""


def group_positions(rows):
    """Up to 64 queries from ``start`` on: their voxels, fractions (u, v, w), and who is ``outside`` of the box."""
    return f"""
    constexpr int G = 64;
    const double origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
    const {rows}* const rows = (const {rows}*)points.data;
    const int count = stop - start < G ? stop - start : G;
    double u[G], v[G], w[G];
    {ONE_BY_ONE}
    for (int q = 0; q < G; ++q) {{
        const {rows}* const p = rows + 3ll * (start + (q < count ? q : 0));
        u[q] = (double)p[0]; v[q] = (double)p[1]; w[q] = (double)p[2];
    }}
    int at_x[G], at_y[G], at_z[G], outside[G];
    for (int q = 0; q < G; ++q) {{
        const double x = u[q] - origin_x, y = v[q] - origin_y, z = w[q] - origin_z;
        const double a = m00 * x + m01 * y + m02 * z, b = m10 * x + m11 * y + m12 * z, c = m20 * x + m21 * y + m22 * z;
        const double i0 = __builtin_floor(a), j0 = __builtin_floor(b), k0 = __builtin_floor(c);
        u[q] = a - i0; v[q] = b - j0; w[q] = c - k0;
        const double i1 = i0 - lower_x, j1 = j0 - lower_y, k1 = k0 - lower_z;
        // False for NaN as well.
        const bool inside = (i1 >= 0.0) & (i1 <= last_x) & (j1 >= 0.0) & (j1 <= last_y) & (k1 >= 0.0) & (k1 <= last_z);
        outside[q] = !inside;
        at_x[q] = inside ? (int)i1 : 0; at_y[q] = inside ? (int)j1 : 0; at_z[q] = inside ? (int)k1 : 0;
    }}
    int first_top[G], first_slot[G], last_top[G], last_slot[G];
    for (int q = 0; q < G; ++q) {{
        const int x = at_x[q], y = at_y[q], z = at_z[q], x1 = x + 1, y1 = y + 1, z1 = z + 1;
        first_top[q] = {slots_of("x", "y", "z")[0]}; first_slot[q] = {slots_of("x", "y", "z")[1]};
        last_top[q] = {slots_of("x1", "y1", "z1")[0]}; last_slot[q] = {slots_of("x1", "y1", "z1")[1]};
    }}
    int first[G], last[G];
    {ONE_BY_ONE}
    for (int q = 0; q < G; ++q) {{
        const int a = top[first_top[q]], b = top[last_top[q]];
        first[q] = a < 0 ? a : slots[a + first_slot[q]];
        last[q] = b < 0 ? b : slots[b + last_slot[q]];
    }}
"""


def group_steps(voxels):
    """Where the first voxel of each cell lies from its ``voxels``, and how far the next one along each axis."""
    return f"""
    long long at[G], step_x[G], step_y[G], step_z[G];
    int apart[G];
    for (int q = 0; q < G; ++q) {{
        const int x = at_x[q] & 7, y = at_y[q] & 7, z = at_z[q] & 7;
        const int borders = (x == 7) + (y == 7) + (z == 7);
        const long long leaf = (long long)first[q] * 8, jump = (long long)last[q] * 8 - leaf;
        const bool tile = first[q] < 0;
        apart[q] = (borders > 1) | ((borders == 1) & (tile | (last[q] < 0)));
        at[q] = tile ? (long long)~first[q] : leaf + 24 + (x << 6 | y << 3 | z);
        step_x[q] = tile ? 0 : x == 7 ? jump - 448 : 64;
        step_y[q] = tile ? 0 : y == 7 ? jump - 56 : 8;
        step_z[q] = tile ? 0 : z == 7 ? jump - 7 : 1;
    }}
    unsigned long long left = 0;
    for (int q = 0; q < G; ++q) {{
        left |= (unsigned long long)(outside[q] != 0) << q;
        const float* const near = {voxels} + at[q];
        const float* const far = apart[q] ? near : near + step_x[q];
        const long long up = apart[q] ? 0 : step_y[q];
        __builtin_prefetch(near);
        __builtin_prefetch(near + up);
        __builtin_prefetch(far);
        __builtin_prefetch(far + up);
    }}
"""


def group_cells(voxels, tree):
    """The eight voxels of each cell; ``tree`` is what the look-up of those in three leaves or more needs first."""
    return f"""
    float cell[8][G];
    for (int q = 0; q < G; ++q) {{
        if (!apart[q]) {{
            const float* c = {voxels} + at[q];
            const long long y = step_y[q], z = step_z[q];
            cell[0][q] = c[0]; cell[1][q] = c[z]; cell[2][q] = c[y]; cell[3][q] = c[y + z];
            c += step_x[q];
            cell[4][q] = c[0]; cell[5][q] = c[z]; cell[6][q] = c[y]; cell[7][q] = c[y + z];
        }} else {{
            {tree}
            {ONE_BY_ONE}
            for (int n = 0; n < 8; ++n) {{
                const int x = at_x[q] + (n >> 2), y = at_y[q] + ((n >> 1) & 1), z = at_z[q] + (n & 1);
                {voxel_entry("x", "y", "z")}
                const long long place = entry < 0 ? (long long)~entry
                    : (long long)entry * 8 + 24 + ((x & 7) << 6 | (y & 7) << 3 | (z & 7));
                cell[n][q] = {voxels}[place];
            }}
        }}
    }}
"""


def group_sums(rows, total, keep, store):
    """The sums of all cells, kept in the arrays ``total`` and stored as ``rows``; returns who was outside."""
    return f"""
    double {total};
    for (int q = 0; q < G; ++q) {{
        const double x = u[q], y = v[q], z = w[q];
        const double c0 = cell[0][q], c1 = cell[1][q], c2 = cell[2][q], c3 = cell[3][q];
        const double c4 = cell[4][q], c5 = cell[5][q], c6 = cell[6][q], c7 = cell[7][q];
        {keep}
    }}
    {rows}* const results = ({rows}*)out.data;
    for (int q = 0; q < count; ++q) {{
        {store}
    }}
    return count == G ? left : left & ((1ull << count) - 1ull);
"""


# The voxels c0 to c7 of the cell (a, b, c), of which e000 is the first voxel's entry.
SINGLE_CELL = """
    double c0, c1, c2, c3, c4, c5, c6, c7;
    if (e000 >= 0 && table.pairs.data) {
        struct alignas(8) Pair { float low, high; };
        const Pair* const p = (const Pair*)table.pairs.data
            + ((long long)((e000 - table.first_leaf) / 67) * 648 + (((a & 7) * 8 + (b & 7)) * 9 + (c & 7)));
        const Pair near_0 = p[0], near_1 = p[1], far_0 = p[72], far_1 = p[73];
        c0 = (double)near_0.low; c1 = (double)near_1.low; c2 = (double)near_0.high; c3 = (double)near_1.high;
        c4 = (double)far_0.low; c5 = (double)far_1.low; c6 = (double)far_0.high; c7 = (double)far_1.high;
    } else {
        // Of the leaves around a cell only those are looked up that it reaches into.
        const bool next_x = (a & 7) == 7, next_y = (b & 7) == 7, next_z = (c & 7) == 7;
        const int e001 = next_z ? entry_of(a, b, c + 1) : e000;
        const int e010 = next_y ? entry_of(a, b + 1, c) : e000;
        const int e100 = next_x ? entry_of(a + 1, b, c) : e000;
        const int e011 = !next_y ? e001 : next_z ? entry_of(a, b + 1, c + 1) : e010;
        const int e101 = !next_x ? e001 : next_z ? entry_of(a + 1, b, c + 1) : e100;
        const int e110 = !next_x ? e010 : next_y ? entry_of(a + 1, b + 1, c) : e100;
        const int e111 = !next_x ? e011 : !next_y ? e101 : next_z ? entry_of(a + 1, b + 1, c + 1) : e110;
        const auto voxel = [&](int entry, int n) {
            return (double)voxels[entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + n];
        };
        const int x0 = (a & 7) << 6, x1 = ((a + 1) & 7) << 6;
        const int y0 = (b & 7) << 3, y1 = ((b + 1) & 7) << 3;
        const int z0 = c & 7, z1 = (c + 1) & 7;
        c0 = voxel(e000, x0 | y0 | z0); c1 = voxel(e001, x0 | y0 | z1);
        c2 = voxel(e010, x0 | y1 | z0); c3 = voxel(e011, x0 | y1 | z1);
        c4 = voxel(e100, x1 | y0 | z0); c5 = voxel(e101, x1 | y0 | z1);
        c6 = voxel(e110, x1 | y1 | z0); c7 = voxel(e111, x1 | y1 | z1);
    }
"""


def overloads(kernel, out, single, double):
    """A kernel by whether points and answers are float32."""
    return {
        is_single: wp.overload(kernel, {"points": wp.array(dtype=rows), out: wp.array(dtype=answers)})
        for is_single, rows, answers in ((True, wp.vec3f, single), (False, wp.vec3d, double))
    }
