#include "convert.h"
#include "errors.h"
#include "open_grids.h"
#include "operations.h"
#include "transform.h"

#include <openvdb/tools/SignedFloodFill.h>

#include <cstring>

namespace geokit {
namespace {

template<typename ValueT>
ValueT value_of(const double* numbers)
{
    if constexpr (std::is_floating_point_v<ValueT>) return ValueT(numbers[0]);
    else return ValueT(numbers[0], numbers[1], numbers[2]);
}

template<typename GridT>
openvdb::GridBase::Ptr assembled(const Leaves& leaves)
{
    using TreeT = typename GridT::TreeType;
    using ValueT = typename TreeT::ValueType;
    using LeafT = typename TreeT::LeafNodeType;
    const auto background = value_of<ValueT>(leaves.background);
    const auto grid = registered_grid<GridT>(background);
    const auto* values = static_cast<const ValueT*>(leaves.values);
    for (size_t i = 0; i < leaves.count; ++i) {
        const openvdb::Coord origin(leaves.origins[3 * i], leaves.origins[3 * i + 1], leaves.origins[3 * i + 2]);
        auto* leaf = new LeafT(origin, background, false);
        std::memcpy(static_cast<void*>(leaf->buffer().data()), values + i * LeafT::SIZE, LeafT::SIZE * sizeof(ValueT));
        typename LeafT::NodeMaskType mask;
        static_assert(sizeof(mask) == 64, "a leaf's mask is 64 bytes");
        std::memcpy(static_cast<void*>(&mask), leaves.masks + 64 * i, sizeof mask);
        leaf->setValueMask(mask);
        grid->tree().addLeaf(leaf);
    }
    if constexpr (std::is_floating_point_v<ValueT>) {
        if (leaves.grid_class == "level set") openvdb::tools::signedFloodFill(grid->tree());
    }
    return grid;
}

} // namespace

MappedBuffer from_leaves(const Leaves& leaves)
{
    initialize();
    openvdb::GridBase::Ptr grid;
    if (leaves.components == 3 && leaves.is_double) grid = assembled<openvdb::Vec3DGrid>(leaves);
    else if (leaves.components == 3) grid = assembled<openvdb::Vec3SGrid>(leaves);
    else if (leaves.is_double) grid = assembled<openvdb::DoubleGrid>(leaves);
    else grid = assembled<openvdb::FloatGrid>(leaves);
    grid->setName(leaves.name);
    const auto grid_class = openvdb::GridBase::stringToGridClass(leaves.grid_class);
    if (grid_class != openvdb::GRID_UNKNOWN) grid->setGridClass(grid_class);
    Affine affine;
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) affine.linear[row][column] = leaves.transform[4 * row + column];
        affine.offset[row] = leaves.transform[4 * row + 3];
    }
    grid->setTransform(transform_of(affine));
    return to_nanovdb(grid);
}

} // namespace geokit
