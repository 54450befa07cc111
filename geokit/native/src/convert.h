// Conversion between OpenVDB grids and NanoVDB buffers.
#pragma once

#include "bridge.h"
#include "library_grids.h"

#include <nanovdb/NanoVDB.h>

namespace geokit {

// Registers OpenVDB's grid types, and the three that NanoVDB has but OpenVDB does not register (uint32, vec4s, vec4d).
// Call it before every other function of the bridge; further calls cost nothing.
void initialize();

// Whether grids of this OpenVDB tree type ("Tree_float_5_4_3") can be converted.
bool is_convertible(const std::string& grid_type);

// Whether grids of this type are points with attributes, see points.h.
bool holds_points(const std::string& grid_type);

// Whether OpenVDB, or a program built on it, may have written a tree type of this name. False means that the name
// itself is damaged.
bool is_plausible_type(const std::string& grid_type);

// Converts values (active and inactive), states, tiles, name, class, transform and background of `grid` to a NanoVDB
// buffer with statistics and a header checksum. The buffer is in the file `path` if one is named, which must not exist
// yet. Vec3I grids become vec3d (exact), because NanoVDB has no integer vectors. The tree is unchanged afterwards but
// is written to meanwhile: do not share it. Throws BridgeError("unsupported").
MappedBuffer to_nanovdb(const openvdb::GridBase::Ptr& grid, const std::string& path = "");

// The inverse. `as_vec3i` converts a vec3d buffer to a Vec3I grid. Quantized types become float grids. `data` must have
// passed check_nanovdb(). Throws BridgeError("unsupported") or ("input").
openvdb::GridBase::Ptr to_openvdb(const uint8_t* data, bool as_vec3i = false);

// Copies the tree with values of the other type, name and class; the caller sets the transform. The doubles must be
// integers. Throws BridgeError("input").
openvdb::Vec3IGrid::Ptr to_vec3i(const openvdb::Vec3DGrid& doubles);
openvdb::Vec3DGrid::Ptr to_vec3d(const openvdb::Vec3IGrid& integers);

// The OpenVDB class that to_openvdb() gives a grid that to_nanovdb() made from one of class `grid_class`. If the two
// differ, the class must be stored beside the buffer.
openvdb::GridClass class_after_round_trip(const openvdb::GridBase& grid);

// Affine transforms, read from and written to OpenVDB and NanoVDB without rounding:
// world = linear * index + offset, in double.
struct Affine {
    double linear[3][3];
    double offset[3];
};

// Throws BridgeError("unsupported") for a frustum, ("damaged") for values that are not finite.
Affine affine_of(const openvdb::math::Transform& transform);
Affine affine_of(const nanovdb::Map& map);

// The simplest of OpenVDB's maps that holds the affine exactly: uniform scale, scale, either with translation, or any.
// OpenVDB's own simplify() computes the scale as (scale + offset) - offset, which rounds, and drops small shears. It
// runs in Transform's constructor, and so whenever a grid is copied: set this transform on the last copy. Throws
// BridgeError("input") if OpenVDB rejects the transform as singular.
openvdb::math::Transform::Ptr transform_of(const Affine& affine);

void store(const Affine& affine, nanovdb::Map& map);

} // namespace geokit
