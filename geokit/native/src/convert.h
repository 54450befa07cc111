// OpenVDB grid <-> NanoVDB buffer.
#pragma once

#include "buffer.h"

#include <openvdb/openvdb.h>

#include <string>

namespace geokit {

// Registers OpenVDB's grid types, and the three that NanoVDB has too but OpenVDB leaves out (uint32, vec4s, vec4d).
// Every other function of the bridge needs it first; calling it again costs nothing.
void initialize();

// Whether grids of this OpenVDB tree type ("Tree_float_5_4_3") can be converted.
bool is_convertible(const std::string& grid_type);

// Whether this is the name of a tree type that OpenVDB or a program built on it may have written. False means that the
// name itself is damaged.
bool is_plausible_type(const std::string& grid_type);

// Values (active and not), states, tiles, name, class, transform and background of `grid` in a NanoVDB buffer with
// statistics and a header checksum; in the file `path` where one is named, which must not exist yet. Vec3I grids become
// vec3d (exact): NanoVDB has no integer vectors. The tree is left as it was but is written to meanwhile: do not share it.
// Throws BridgeError("unsupported").
MappedBuffer to_nanovdb(const openvdb::GridBase::Ptr& grid, const std::string& path = "");

// The inverse. `as_vec3i` turns a vec3d buffer into a Vec3I grid. Quantised types become float grids.
// `data` must have passed check_nanovdb(). Throws BridgeError("unsupported") or ("input").
openvdb::GridBase::Ptr to_openvdb(const uint8_t* data, bool as_vec3i = false);

// The same tree with values of the other type, name and class; the transform is left to the caller. The doubles must be
// integers. Throws BridgeError("input").
openvdb::Vec3IGrid::Ptr to_vec3i(const openvdb::Vec3DGrid& doubles);
openvdb::Vec3DGrid::Ptr to_vec3d(const openvdb::Vec3IGrid& integers);

// The OpenVDB class that to_openvdb() gives a grid that to_nanovdb() made from one of class `grid_class`: what differs
// has to be kept beside the buffer.
openvdb::GridClass class_after_round_trip(const openvdb::GridBase& grid);

} // namespace geokit
