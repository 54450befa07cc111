// The finest cell around a point, for fields of any order and codec.
//
// Expects levels, an AdaptiveLevels, and u, index coordinates of level 0 within int32. Returns a wp::vec_t<4, int>: the
// level, and the first voxel of its cell. A point beyond the box of the first table belongs to level 0.
#include "volume/sampling/table_look_up.inl"
#define LEVEL_TABLE(level) levels.tables.data[level]
#define LEAF_STEP(level) levels.step.data[level]
const double i0 = floor(u[0]), j0 = floor(u[1]), k0 = floor(u[2]);
int i = (int)i0, j = (int)j0, k = (int)k0;
const auto& coarsest = LEVEL_TABLE(0);
const double i1 = i0 - coarsest.lower[0], j1 = j0 - coarsest.lower[1], k1 = k0 - coarsest.lower[2];
if (!(i1 >= 0.0 && i1 < coarsest.size[0] * 128.0 && j1 >= 0.0 && j1 < coarsest.size[1] * 128.0 && k1 >= 0.0
      && k1 < coarsest.size[2] * 128.0))
    return wp::vec_t<4, int>(0, i, j, k);
double x = u[0] - i0, y = u[1] - j0, z = u[2] - k0;
#include "volume/adaptive/descent.inl"
const auto& finest = LEVEL_TABLE(level);
return wp::vec_t<4, int>(level, a + finest.lower[0], b + finest.lower[1], c + finest.lower[2]);
#undef LEVEL_TABLE
#undef LEAF_STEP
#undef UPPER_OF
#undef SLOT_OF
#undef TREE_OF
#undef FIND_ENTRY
