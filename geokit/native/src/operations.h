// Operations on volumes, from NanoVDB buffers to buffers, computed by OpenVDB's tools. Includes no OpenVDB header.
// Every input buffer must have passed check_nanovdb(). All functions throw BridgeError("unsupported") for a grid type
// that the operation does not support, and ("input") if OpenVDB rejects an argument. Quantized grids become float
// grids. Name, class and transform are those of the first operand.
#pragma once

#include "bridge.h"
#include "pulse.h"

#include <array>

namespace geokit {

// Level sets below are float or double grids on one lattice of cubic voxels, both operands of one type. Lengths are in
// voxels; `voxel_size` is the length of a voxel's edge in the unit of the values.

// "union", "intersection" or "difference" of level sets with equal backgrounds: minimum or maximum per voxel.
MappedBuffer csg(const uint8_t* a, const uint8_t* b, const std::string& kind, const Pulse& pulse);

// The same with a polynomial smooth minimum of the given blending width [unit of the values]. Both bands must reach
// `blend` beyond the surface. The result is not a distance field yet.
MappedBuffer smooth_csg(const uint8_t* a, const uint8_t* b, const std::string& kind, double blend, const Pulse& pulse);

// Smoothing "gaussian", "mean", "median", and for level sets also "mean_curvature" and "laplacian". `width` in voxels.
MappedBuffer smooth(
    const uint8_t* data, const std::string& method, int width, int iterations, double voxel_size, const Pulse& pulse);

// Area [voxels^2] and volume [voxels^3] of a level set.
std::pair<double, double> measure(const uint8_t* data, double voxel_size, const Pulse& pulse);

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
