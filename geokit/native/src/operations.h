// Operations on volumes: NanoVDB buffers in, buffers out, computed by OpenVDB's tools. Includes no OpenVDB header.
// Every buffer that goes in must have passed check_nanovdb(). All throw BridgeError("unsupported") for a grid type that
// the operation has not, and ("input") where OpenVDB refuses an argument. Quantised grids become float grids. Name,
// class and transform are those of the first operand.
#pragma once

#include "buffer.h"

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

namespace geokit {

// Level sets below are float or double grids, both operands of one type, on one voxel lattice of cubic voxels. Lengths
// are in voxels; `voxel_size` is what a voxel's edge measures in the unit of the values.

// "union", "intersection" or "difference" of level sets with equal backgrounds: per voxel minimum or maximum.
MappedBuffer csg(const uint8_t* a, const uint8_t* b, const std::string& kind);

// The same with a polynomial smooth minimum of the given blending width [unit of the values]. Both bands must reach
// `blend` beyond the surface; the result is not a distance yet.
MappedBuffer smooth_csg(const uint8_t* a, const uint8_t* b, const std::string& kind, double blend);

// Signed distances, in a band of `half_width`, from the surface where the values are `isovalue` [voxels]. With
// `keeps_band`, active voxels keep their values and only new ones are computed (isovalue must then be 0).
MappedBuffer redistance(const uint8_t* data, double voxel_size, double half_width, double isovalue, bool keeps_band);

// Smoothing "gaussian", "mean", "median", and for level sets also "mean_curvature" and "laplacian". `width` in voxels.
MappedBuffer smooth(const uint8_t* data, const std::string& method, int width, int iterations, double voxel_size);

// Area [voxels^2] and volume [voxels^3] of a level set.
std::pair<double, double> measure(const uint8_t* data, double voxel_size);

// Regions whose values differ by at most `tolerance` and share their state become tiles.
MappedBuffer prune(const uint8_t* data, double tolerance);

// Voxels whose centres are outside the box [world] become inactive background.
MappedBuffer clip(const uint8_t* data, const double lower[3], const double upper[3]);

// Connected components, largest first: of the inside of a float or double level set with cubic voxels, else of the active
// voxels. Throws BridgeError("memory") where labelling the inside would take more than `memory_limit` bytes.
std::vector<MappedBuffer> segment(const uint8_t* data, double voxel_size, double memory_limit);

// The grid without active tiles: each is replaced by leaves. Quantised values become float.
MappedBuffer voxelized(const uint8_t* data);

// A grid made of leaves. `values` holds 512 values of `components` each per leaf, z fastest; `masks` 64 bytes per leaf.
// `transform` is the upper three rows of the index-to-world matrix. A level set gets the signs of its empty regions.
struct Leaves {
    const int32_t* origins;
    const void* values;
    const uint8_t* masks;
    size_t count;
    int components; // 1 or 3
    bool is_double;
    double background[3];
    std::string name;
    std::string grid_class; // OpenVDB's name: "level set", "fog volume", "staggered", "unknown"
    double transform[12];
};
MappedBuffer from_leaves(const Leaves& leaves);

} // namespace geokit
