// The OpenVDB grid types that the bridge converts, and a way to create them that compiles fast.
#pragma once

#include "library_grids.h"

namespace geokit {

// In NanoVDB's type lists, but not registered by OpenVDB; extra_grids.cpp registers them.
using UInt32Grid = openvdb::Grid<openvdb::UInt32Tree>;
using Vec4fGrid = openvdb::Grid<openvdb::tree::Tree4<openvdb::Vec4s, 5, 4, 3>::Type>;
using Vec4dGrid = openvdb::Grid<openvdb::tree::Tree4<openvdb::Vec4d, 5, 4, 3>::Type>;

void register_extra_grids();

// Types with a NanoVDB counterpart. Vec3IGrid is supported too, through Vec3DGrid.
using DirectGrids = openvdb::TypeList<openvdb::FloatGrid, openvdb::DoubleGrid, openvdb::Int32Grid, openvdb::Int64Grid,
    UInt32Grid, openvdb::Vec3SGrid, openvdb::Vec3DGrid, openvdb::BoolGrid, openvdb::MaskGrid, Vec4fGrid, Vec4dGrid>;

// Creates a grid through OpenVDB's registry. Calling a constructor instead makes the compiler emit every virtual
// function of the grid and its tree again: 12 seconds a type, for code that libopenvdb already contains.
template<typename GridT>
typename GridT::Ptr registered_grid(const typename GridT::ValueType& background)
{
    const auto grid = openvdb::StaticPtrCast<GridT>(openvdb::GridBase::createGrid(GridT::gridType()));
    grid->tree().root().setBackground(background, /*updateChildNodes=*/false);
    return grid;
}

} // namespace geokit

// NanoVDB's converter creates its result with openvdb::createGrid(); this makes it use the registry too.
namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {

#define GEOKIT_CREATE_REGISTERED(GridT)                                                                                \
    template<>                                                                                                         \
    inline GridT::Ptr createGrid<GridT>(const GridT::ValueType& background)                                            \
    { return geokit::registered_grid<GridT>(background); }

GEOKIT_CREATE_REGISTERED(FloatGrid)
GEOKIT_CREATE_REGISTERED(DoubleGrid)
GEOKIT_CREATE_REGISTERED(Int32Grid)
GEOKIT_CREATE_REGISTERED(Int64Grid)
GEOKIT_CREATE_REGISTERED(geokit::UInt32Grid)
GEOKIT_CREATE_REGISTERED(Vec3SGrid)
GEOKIT_CREATE_REGISTERED(Vec3DGrid)
GEOKIT_CREATE_REGISTERED(BoolGrid)
GEOKIT_CREATE_REGISTERED(MaskGrid)
GEOKIT_CREATE_REGISTERED(geokit::Vec4fGrid)
GEOKIT_CREATE_REGISTERED(geokit::Vec4dGrid)

#undef GEOKIT_CREATE_REGISTERED

} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb
