#include "interrupter.h"
#include "level_set.h"
#include "operations.h"

#include <openvdb/tools/Filter.h>
#include <openvdb/tools/LevelSetFilter.h>

namespace geokit {
namespace {

template<typename GridT>
void smooth_level_set(
    GridT& grid, const std::string& method, int width, int iterations, double voxel_size, Interrupter& interrupter)
{
    InVoxels voxels(grid, voxel_size);
    {
        openvdb::tools::LevelSetFilter<GridT> filter(grid, &interrupter);
        for (int i = 0; i < iterations; ++i) {
            if (method == "gaussian") filter.gaussian(width);
            else if (method == "mean") filter.mean(width);
            else if (method == "median") filter.median(width);
            else if (method == "mean_curvature") filter.meanCurvature();
            else if (method == "laplacian") filter.laplacian();
            else throw BridgeError("input", "'" + method + "' is no smoothing method");
        }
    }
    voxels.leave();
}

template<typename GridT>
void smooth_field(GridT& grid, const std::string& method, int width, int iterations, Interrupter& interrupter)
{
    openvdb::tools::Filter<GridT> filter(grid, &interrupter);
    if (method == "gaussian") filter.gaussian(width, iterations);
    else if (method == "mean") filter.mean(width, iterations);
    else if (method == "median") filter.median(width, iterations);
    else throw BridgeError("input", "'" + method + "' smooths level sets only");
}

} // namespace

MappedBuffer smooth(
    const uint8_t* data, const std::string& method, int width, int iterations, double voxel_size, const Pulse& pulse)
{
    Interrupter interrupter(pulse);
    return on_real(to_openvdb(data), "smoothing", [&](auto& grid) {
        if (grid.getGridClass() == openvdb::GRID_LEVEL_SET)
            smooth_level_set(grid, method, width, iterations, voxel_size, interrupter);
        else smooth_field(grid, method, width, iterations, interrupter);
    });
}

} // namespace geokit
