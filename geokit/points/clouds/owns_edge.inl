// Whether i, which has j for a neighbor, is the one to list their edge: where both do, the lower does.
//
// Expects neighbor, i, j. Returns the answer. In C++, where the loop over a row is vectorized.

const int width = neighbor.shape[1];
if (j < 0 || j == i)
    return false;
if (i < j)
    return true;
const int* const row = neighbor.data + (int64_t)j * width;
bool mutual = false;
for (int k = 0; k < width; ++k)
    mutual |= row[k] == i;
return !mutual;
