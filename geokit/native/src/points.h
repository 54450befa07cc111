// Grids of points: OpenVDB's PointDataGrid as arrays, and arrays as a PointDataGrid. Includes no OpenVDB header.
#pragma once

#include "bridge.h"

namespace geokit {

// One attribute of all points, in the order of the voxels.
struct PointColumn {
    std::string name;
    std::string type;  // OpenVDB's name: "float", "int32", "vec3s", ...; "group" for the members of a group, as bool
    uint64_t width;    // values of a point: the stride times the components of a vector
    std::string bytes; // row after row
};

struct PointTable {
    std::string name;              // of the grid
    std::vector<double> positions; // world
    std::vector<PointColumn> columns;
    std::vector<std::string> left_out; // attributes that are no numbers: text, matrices, lists
    std::string note;                  // what write_points() was given
};

// Reads the grid of points called `name`, or the only one of the file if it is empty. Points of inactive voxels are read
// too. Throws BridgeError("missing"), ("unsupported"), ("damaged"), ("access").
PointTable read_points(const std::string& path, const std::string& name);

// Points of `voxels` of one size, sorted by leaf, and by voxel within each.
struct PointLeaves {
    std::string name;
    double voxel_size;
    double origin[3]; // world place of the center of voxel (0, 0, 0)
    uint64_t leaf_count;
    const int32_t* corners;            // (leaf_count, 3): coordinates of the leaf's first voxel
    const int64_t* starts;             // (leaf_count + 1): its first point
    const uint16_t* voxels;            // of each point: number of the voxel in its leaf, x slowest
    const float* positions;            // of each point, (3): from the voxel's center, -0.5 to 0.5
    std::vector<PointColumn> columns;  // "bytes" is empty
    std::vector<const uint8_t*> bytes; // of each column
    std::string note;                  // kept in the file
};

// Writes one grid. Throws BridgeError as write_vdb() does.
void write_points(const std::string& path, const PointLeaves& points, const std::string& compression);

} // namespace geokit
