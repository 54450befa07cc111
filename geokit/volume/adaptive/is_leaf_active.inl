// Whether the voxel (i, j, k) lies in a leaf of a LeafTable's grid and is active there.
//
// Expects table, i, j, k. Returns the bool.
const int x = i - table.lower[0], y = j - table.lower[1], z = k - table.lower[2];
if (x < 0 || y < 0 || z < 0) return false;
if (x >= table.size[0] * 128 || y >= table.size[1] * 128 || z >= table.size[2] * 128) return false;
const int start = table.top.data[((x >> 7) * table.size[1] + (y >> 7)) * table.size[2] + (z >> 7)];
if (start < 0) return false;
const int entry = table.slots.data[start + (((x >> 3) & 15) << 8 | ((y >> 3) & 15) << 4 | ((z >> 3) & 15))];
if (entry < 0) return false;
typedef unsigned long long word;
const word* const mask = (const word*)(table.grid + (word)entry * 32ull + 16ull);
return (mask[x & 7] >> ((y & 7) << 3 | (z & 7))) & 1ull;
