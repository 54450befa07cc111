// The value of voxel (i, j, k) of a float grid; the voxel must lie in the box of the grid's LeafTable.
//
// Expects table, i, j, k. Returns the float.
const int x = i - table.lower[0], y = j - table.lower[1], z = k - table.lower[2];
const int start = table.top.data[((x >> 7) * table.size[1] + (y >> 7)) * table.size[2] + (z >> 7)];
const int entry =
    start < 0 ? start : table.slots.data[start + (((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15))];
const long long at =
    entry < 0 ? (long long)~entry : (long long)entry * 8 + 24 + ((x & 7) << 6 | (y & 7) << 3 | (z & 7));
return ((const float*)table.grid)[at];
