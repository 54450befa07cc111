// Binary search for the border block that starts at the voxel (i, j, k). Border blocks are sorted by x, then y, then z.
//
// Expects cells, border_count, i, j, k. Returns the block's number, -1 for none.

const wp::vec_t<3, int>* blocks = cells.origin.data + cells.leaf_count;
int low = 0, high = border_count;
while (low < high) {
    const int middle = (low + high) / 2;
    const wp::vec_t<3, int>& r = blocks[middle];
    const bool before = r[0] != i ? r[0] < i : r[1] != j ? r[1] < j : r[2] < k;
    if (before) low = middle + 1;
    else high = middle;
}
const bool found = low < border_count && blocks[low][0] == i && blocks[low][1] == j && blocks[low][2] == k;
return found ? cells.leaf_count + low : -1;
