// Signed distances from the zero set of a level set, which stays in place.
#pragma once

#include <openvdb/openvdb.h>

namespace geokit {

// Computes signed distances, in a band of `half_width`, from the surface where the values equal `isovalue`. With
// `keeps_band`, active voxels keep their values and only new ones are computed (isovalue must then be 0). Values and
// transform are in voxels.
template<typename GridT>
void redistance(GridT& grid, double half_width, double isovalue, bool keeps_band);

extern template void redistance(openvdb::FloatGrid&, double, double, bool);
extern template void redistance(openvdb::DoubleGrid&, double, double, bool);

} // namespace geokit
