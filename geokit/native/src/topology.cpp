// Operations that change which voxels and tiles there are, not their values.
#include "level_set.h"
#include "open_grids.h"
#include "operations.h"
#include "transform.h"

#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <limits>

namespace geokit {
namespace {

// The types for which OpenVDB's library has these tools compiled.
using VolumeGrids = openvdb::TypeList<openvdb::FloatGrid, openvdb::DoubleGrid, openvdb::Int32Grid, openvdb::Int64Grid,
    openvdb::Vec3SGrid, openvdb::Vec3DGrid, openvdb::BoolGrid>;

template<typename Grids, typename Op>
void on_types(openvdb::GridBase& grid, const char* what, Op&& op)
{
    if (!grid.apply<Grids>(op)) {
        throw BridgeError("unsupported", std::string(what) + " does not take grids of type " + grid.valueType());
    }
}

struct Box {
    const double* lower;
    const double* upper;
    Affine affine;

    bool contains(const openvdb::Coord& voxel) const
    {
        for (int row = 0; row < 3; ++row) {
            const double* m = affine.linear[row];
            const double world = m[0] * voxel[0] + m[1] * voxel[1] + m[2] * voxel[2] + affine.offset[row];
            if (!(world >= lower[row] && world <= upper[row])) return false;
        }
        return true;
    }

    // All voxels whose centres may be inside.
    openvdb::CoordBBox voxels(const openvdb::math::Transform& transform) const
    {
        openvdb::Vec3d least(std::numeric_limits<double>::max()), most(-std::numeric_limits<double>::max());
        for (int corner = 0; corner < 8; ++corner) {
            openvdb::Vec3d point;
            for (int axis = 0; axis < 3; ++axis) point[axis] = corner >> axis & 1 ? upper[axis] : lower[axis];
            const auto index = transform.worldToIndex(point);
            least = openvdb::math::minComponent(least, index);
            most = openvdb::math::maxComponent(most, index);
        }
        openvdb::Coord first, last;
        const double limit = 2147483000.0;
        for (int axis = 0; axis < 3; ++axis) {
            // A voxel more on each side: contains() decides, this only has to be large enough.
            first[axis] = int(std::clamp(std::floor(least[axis]) - 1.0, -limit, limit));
            last[axis] = int(std::clamp(std::ceil(most[axis]) + 1.0, -limit, limit));
        }
        return {first, last};
    }
};

template<typename GridT>
void clip_grid(GridT& grid, const Box& box)
{
    auto& tree = grid.tree();
    tree.clip(box.voxels(grid.transform()));
    tree.voxelizeActiveTiles();
    const auto background = tree.background();
    openvdb::tree::LeafManager<typename GridT::TreeType> leaves(tree);
    leaves.foreach([&](auto& leaf, size_t) {
        for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
            if (!box.contains(leaf.offsetToGlobalCoord(n))) leaf.setValueOff(n, background);
        }
    });
    openvdb::tools::prune(tree);
}

} // namespace

MappedBuffer prune(const uint8_t* data, double tolerance)
{
    const auto grid = to_openvdb(data);
    const auto transform = grid->transformPtr();
    on_types<VolumeGrids>(*grid, "pruning", [&](auto& typed) {
        using ValueT = typename std::decay_t<decltype(typed)>::ValueType;
        if constexpr (std::is_same_v<ValueT, bool>) openvdb::tools::prune(typed.tree(), false);
        else openvdb::tools::prune(typed.tree(), ValueT(tolerance));
    });
    grid->setTransform(transform);
    return to_nanovdb(grid);
}

MappedBuffer clip(const uint8_t* data, const double lower[3], const double upper[3])
{
    const auto grid = to_openvdb(data);
    const auto transform = grid->transformPtr();
    const Box box{lower, upper, affine_of(*transform)};
    on_types<VolumeGrids>(*grid, "clipping", [&](auto& typed) { clip_grid(typed, box); });
    grid->setTransform(transform);
    return to_nanovdb(grid);
}

MappedBuffer voxelized(const uint8_t* data)
{
    const auto grid = to_openvdb(data);
    const auto transform = grid->transformPtr();
    on_types<VolumeGrids>(*grid, "this operation", [](auto& typed) { typed.tree().voxelizeActiveTiles(); });
    grid->setTransform(transform);
    return to_nanovdb(grid);
}

} // namespace geokit
