// OpenVDB's headers, with the grids that libopenvdb itself contains declared as compiled elsewhere.
#pragma once

#include "pulsed_loops.h" // before OpenVDB's headers

#include <openvdb/openvdb.h>

// libopenvdb registers these grids, so it contains all virtual functions of the grids and of their trees. Without a
// declaration, each file that makes one compiles them again: 12 seconds a type. What OpenVDB's own tools call besides
// is inlined, in the library as well, or in library_grids.cpp. That depends on the release and on optimization, so
// CMakeLists.txt defines GEOKIT_LIBRARY_GRIDS only where it was tried; tests/native/test_extension.py looks for symbols
// that nobody defines.
#ifdef GEOKIT_LIBRARY_GRIDS
namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {

#define GEOKIT_IN_LIBRARY(TreeT)                                                                                       \
    extern template class tree::Tree<TreeT::RootNodeType>;                                                             \
    extern template class Grid<TreeT>;

GEOKIT_IN_LIBRARY(BoolTree)
GEOKIT_IN_LIBRARY(MaskTree)
GEOKIT_IN_LIBRARY(FloatTree)
GEOKIT_IN_LIBRARY(DoubleTree)
GEOKIT_IN_LIBRARY(Int32Tree)
GEOKIT_IN_LIBRARY(Int64Tree)
GEOKIT_IN_LIBRARY(Vec3STree)
GEOKIT_IN_LIBRARY(Vec3DTree)
GEOKIT_IN_LIBRARY(Vec3ITree)

#undef GEOKIT_IN_LIBRARY

} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb
#endif
