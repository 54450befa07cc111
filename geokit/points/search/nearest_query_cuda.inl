// The k nearest points on a GPU: the query of a thread and its bound.
//
// Expects tree, queries, query, LEAF, NONE. Defines the query (x, y, z), its row of the result, bound and before(a, i,
// b, j): whether the squared distance a of point i comes before b of point j.

const int k = queries.k, owner = queries.index.data[query];
// The rest of a block.
if (owner == NONE) return;
const double infinite = 1.0e308 * 10.0;
const int block = query / LEAF, seed = queries.seeded ? block : -1, self = queries.excluded ? owner : -1;
const double* own = queries.positions.data + (size_t)block * 3 * LEAF + query % LEAF;
const double x = own[0], y = own[LEAF], z = own[2 * LEAF];
const double limit = queries.limit_squared.data[queries.limit_squared.shape[0] > 1 ? owner : 0];
double* row = queries.distance.data + (size_t)owner * k;
int* indices = queries.indices.data + (size_t)owner * k;
double bound = limit;
int bound_index = NONE;
auto before = [](double a, int i, double b, int j) { return a < b || (a == b && i < j); };
