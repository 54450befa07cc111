// Whether point i, which has the neighbor j, lists their edge; if both have each other, the lower index lists it.
//
// Expects neighbor, i, j. Returns the result. In C++, where the loop over a row is vectorized.

const int width = neighbor.shape[1];
if (j < 0 || j == i) return false;
if (i < j) return true;
const int* const row = neighbor.data + (int64_t)j * width;
bool mutual = false;
for (int k = 0; k < width; ++k) mutual |= row[k] == i;
return !mutual;
