#include "convert.h"

#include <cmath>

namespace geokit {
namespace {

openvdb::Vec3d converted(const openvdb::Vec3i& value) { return openvdb::Vec3d(value[0], value[1], value[2]); }

openvdb::Vec3i converted(const openvdb::Vec3d& value)
{
    openvdb::Vec3i integers;
    for (int i = 0; i < 3; ++i) {
        // The comparison is written so that a NaN fails too.
        if (!(value[i] >= -2147483648.0 && value[i] <= 2147483647.0) || std::floor(value[i]) != value[i]) {
            throw BridgeError("input", "a grid marked as integer vectors holds a value that is no 32-bit integer");
        }
        integers[i] = openvdb::Int32(value[i]);
    }
    return integers;
}

// OpenVDB has no conversion between real and integer vectors: copy the topology, then every value, active or not.
template<typename TargetGrid, typename SourceGrid>
typename TargetGrid::Ptr convert(const SourceGrid& source)
{
    using Tree = typename TargetGrid::TreeType;
    auto tree = std::make_shared<Tree>(source.tree(), converted(source.background()), openvdb::TopologyCopy());
    size_t count = 0;
    for (auto it = source.tree().cbeginValueAll(); it; ++it) {
        if (++count % 4096 == 0) pulse_if_any();
        tree->addTile(it.getLevel(), it.getCoord(), converted(*it), it.isValueOn());
    }
    auto grid = TargetGrid::create(tree);
    grid->setName(source.getName());
    grid->setGridClass(source.getGridClass());
    return grid;
}

} // namespace

openvdb::Vec3IGrid::Ptr to_vec3i(const openvdb::Vec3DGrid& doubles) { return convert<openvdb::Vec3IGrid>(doubles); }

openvdb::Vec3DGrid::Ptr to_vec3d(const openvdb::Vec3IGrid& integers) { return convert<openvdb::Vec3DGrid>(integers); }

} // namespace geokit
