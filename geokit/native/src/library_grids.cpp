#include "library_grids.h"

// Small functions that libopenvdb has inlined only, so that it lacks them where the compiler does not inline them here.
#ifdef GEOKIT_LIBRARY_GRIDS
namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {

#define GEOKIT_DEFINE_INLINED(TreeT)                                                                                   \
    template Name Grid<TreeT>::gridType();                                                                             \
    template TreeT& Grid<TreeT>::tree();                                                                               \
    template const TreeT& Grid<TreeT>::tree() const;                                                                   \
    template TreeT::RootNodeType& tree::Tree<TreeT::RootNodeType>::root();                                             \
    template const TreeT::RootNodeType& tree::Tree<TreeT::RootNodeType>::root() const;

GEOKIT_DEFINE_INLINED(BoolTree)
GEOKIT_DEFINE_INLINED(MaskTree)
GEOKIT_DEFINE_INLINED(FloatTree)
GEOKIT_DEFINE_INLINED(DoubleTree)
GEOKIT_DEFINE_INLINED(Int32Tree)
GEOKIT_DEFINE_INLINED(Int64Tree)
GEOKIT_DEFINE_INLINED(Vec3STree)
GEOKIT_DEFINE_INLINED(Vec3DTree)
GEOKIT_DEFINE_INLINED(Vec3ITree)

#undef GEOKIT_DEFINE_INLINED

} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb
#endif
