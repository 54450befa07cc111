#include "interrupter.h"
#include "level_set.h"
#include "operations.h"

#include <openvdb/tools/LevelSetMeasure.h>

namespace geokit {
namespace {

template<typename GridT>
std::pair<double, double> measured(GridT& grid, double voxel_size, Interrupter& interrupter)
{
    const InVoxels voxels(grid, voxel_size);
    openvdb::tools::LevelSetMeasure<GridT, Interrupter> tool(grid, &interrupter);
    return {double(tool.area(false)), double(tool.volume(false))};
}

} // namespace

std::pair<double, double> measure(const uint8_t* data, double voxel_size, const Pulse& pulse)
{
    Interrupter interrupter(pulse);
    const auto grid = to_openvdb(data);
    if (auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(grid)) return measured(*floats, voxel_size, interrupter);
    if (auto doubles = openvdb::gridPtrCast<openvdb::DoubleGrid>(grid))
        return measured(*doubles, voxel_size, interrupter);
    throw BridgeError("unsupported", "measuring needs a float or double grid, not " + grid->valueType());
}

} // namespace geokit
