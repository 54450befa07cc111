// Binary search for the border block that starts at the voxel (i, j, k). Border blocks are sorted by x, then y, then z.
//
// Expects cells, rim_count, i, j, k. Returns the block's number, -1 for none.

const wp::vec_t<3, int>* rims = cells.origin.data + cells.leaf_count;
int low = 0, high = rim_count;
while (low < high) {
    const int middle = (low + high) / 2;
    const wp::vec_t<3, int>& r = rims[middle];
    const bool before = r[0] != i ? r[0] < i : r[1] != j ? r[1] < j : r[2] < k;
    if (before) low = middle + 1; else high = middle;
}
const bool found = low < rim_count && rims[low][0] == i && rims[low][1] == j && rims[low][2] == k;
return found ? cells.leaf_count + low : -1;
