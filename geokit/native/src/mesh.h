// OpenVDB's own conversions between volumes and meshes.
#pragma once

#include "buffer.h"
#include "pulse.h"

#include <array>
#include <cstdint>
#include <vector>

namespace geokit {

struct PolygonMesh {
    std::vector<std::array<double, 3>> points; // world
    std::vector<std::array<int32_t, 3>> triangles;
    std::vector<std::array<int32_t, 4>> quads;
};

// The isosurface of a float or double grid (quantized ones as float). Polygons run counter-clockwise seen from the side
// of greater values, which is the outside of a signed distance that is negative inside, under any transform. `data`
// must have passed check_nanovdb(). Throws BridgeError("unsupported") for other types, ("memory") beyond 2^31 points.
PolygonMesh volume_to_mesh(const uint8_t* data, double isovalue, double adaptivity, const Pulse& pulse);

// OpenVDB's meshToVolume: a float level set, negative inside, with `half_width` voxels on either side of the surface.
// `points` are world, (count, 3); `triangles` are (count, 3) and must lie in range.
MappedBuffer mesh_to_level_set(const double* points, size_t point_count, const int32_t* triangles,
    size_t triangle_count, double voxel_size, double half_width, const Pulse& pulse);

} // namespace geokit
