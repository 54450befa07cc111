// Operations on volumes, from NanoVDB buffers to buffers, computed by OpenVDB's tools. Includes no OpenVDB header.
// Every input buffer must have passed check_nanovdb(). All functions throw BridgeError("unsupported") for a grid type
// that the operation does not support, and ("input") if OpenVDB rejects an argument. Quantized grids become float
// grids. Name, class and transform are those of the first operand.
#pragma once

#include "buffer.h"
#include "pulse.h"

#include <cstdint>
#include <string>
#include <utility>

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

} // namespace geokit
