// Descends from the cell of level 0 around a point to the finest cell that contains it. While a cell's bit says that it
// is refined, the next cell is the one of its halves that contains the point.
//
// Expects levels, an AdaptiveLevels; i, j, k, the cell of level 0, and x, y, z, the point's fractions in it, which
// become those in the finest cell; LEVEL_TABLE, LEAF_STEP, TREE_OF and FIND_ENTRY. Defines level; a, b, c, the cell's place in
// the box of the level's table; e000, the entry of its first voxel.
int level = 0, e000, a, b, c;
for (;;) {
    const auto& table = LEVEL_TABLE(level);
    TREE_OF(table)
    a = i - table.lower[0];
    b = j - table.lower[1];
    c = k - table.lower[2];
    FIND_ENTRY(a, b, c)
    e000 = entry;
    if (entry < 0 || level + 1 == levels.tables.shape[0]) break;
    const unsigned bits =
        levels.finer
            .data[levels.first_word.data[level] + 16ll * ((entry - levels.first_entry.data[level]) / LEAF_STEP(level))
                  + ((a & 7) << 1 | (b & 7) >> 2)];
    if (!((bits >> ((b & 3) << 3 | (c & 7))) & 1u)) break;
    const int p = x >= 0.5, q = y >= 0.5, r = z >= 0.5;
    const auto& moved = levels.shift.data[level];
    i = 2 * i + moved[0] + p;
    j = 2 * j + moved[1] + q;
    k = 2 * k + moved[2] + r;
    // Doubling is exact.
    x = 2.0 * x - p;
    y = 2.0 * y - q;
    z = 2.0 * z - r;
    ++level;
}
