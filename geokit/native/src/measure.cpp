#include "level_set.h"
#include "operations.h"

#include <openvdb/tools/LevelSetMeasure.h>

namespace geokit {
namespace {

template<typename GridT>
std::pair<double, double> measured(GridT& grid, double voxel_size)
{
    const InVoxels voxels(grid, voxel_size);
    openvdb::tools::LevelSetMeasure<GridT> tool(grid);
    return {double(tool.area(false)), double(tool.volume(false))};
}

} // namespace

std::pair<double, double> measure(const uint8_t* data, double voxel_size)
{
    const auto grid = to_openvdb(data);
    if (auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(grid)) return measured(*floats, voxel_size);
    if (auto doubles = openvdb::gridPtrCast<openvdb::DoubleGrid>(grid)) return measured(*doubles, voxel_size);
    throw BridgeError("unsupported", "measuring needs a float or double grid, not " + grid->valueType());
}

} // namespace geokit
