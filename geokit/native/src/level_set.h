// Shared by the operations on level sets: the supported types, and values in units of voxels.
#pragma once

#include "convert.h"
#include "errors.h"
#include "library_grids.h"

#include <openvdb/tree/LeafManager.h>

#include <cmath>

namespace geokit {

// Calls op(grid) with the typed grid and returns the result as a buffer under the grid's original transform; operations
// may change the transform meanwhile.
template<typename Op>
MappedBuffer on_real(const openvdb::GridBase::Ptr& grid, const char* what, Op&& op)
{
    const auto transform = grid->transformPtr();
    if (auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(grid)) op(*floats);
    else if (auto doubles = openvdb::gridPtrCast<openvdb::DoubleGrid>(grid)) op(*doubles);
    else
        throw BridgeError("unsupported", std::string(what) + " needs a float or double grid, not " + grid->valueType());
    grid->setTransform(transform);
    return to_nanovdb(grid);
}

// Multiplies every value, including tiles and background. Values equal to the background's magnitude become exactly
// `background`, so that the conversion to voxels and back does not round them.
template<typename TreeT>
void scale_values(TreeT& tree, double factor, double background)
{
    using ValueT = typename TreeT::ValueType;
    const ValueT before = tree.background();
    const auto scaled = [=](ValueT value) {
        if (value == before) return ValueT(background);
        if (value == -before) return ValueT(-background);
        return ValueT(double(value) * factor);
    };
    openvdb::tree::LeafManager<TreeT> leaves(tree);
    leaves.foreach([&](auto& leaf, size_t) {
        ValueT* values = leaf.buffer().data();
        for (openvdb::Index i = 0; i < leaf.SIZE; ++i) values[i] = scaled(values[i]);
    });
    auto it = tree.beginValueAll();
    it.setMaxDepth(it.getLeafDepth() - 1);
    for (; it; ++it) it.setValue(scaled(*it));
    tree.root().setBackground(ValueT(background), /*updateChildNodes=*/false);
}

// Scales values and transform to voxels while the object lives; `half_width` may be changed meanwhile. OpenVDB's level
// set tools use the transform only for the size of a voxel, and treat small voxels as a singular transform.
template<typename GridT>
class InVoxels {
public:
    InVoxels(GridT& grid, double voxel_size) : grid_(grid), voxel_size_(voxel_size)
    {
        background = double(grid.background());
        scale_values(grid.tree(), 1.0 / voxel_size, background / voxel_size);
        grid.setTransform(openvdb::math::Transform::createLinearTransform(1.0));
    }
    void leave() { scale_values(grid_.tree(), voxel_size_, background); }

    double background; // after leave(), in the unit of the values

private:
    GridT& grid_;
    double voxel_size_;
};

} // namespace geokit
