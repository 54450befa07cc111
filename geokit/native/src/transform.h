// Affine transforms, read from and written to OpenVDB and NanoVDB without rounding.
#pragma once

#include <nanovdb/NanoVDB.h>
#include <openvdb/math/Transform.h>

namespace geokit {

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
