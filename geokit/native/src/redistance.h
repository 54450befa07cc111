// Signed distances from the zero set of a level set, which stays where it is.
#pragma once

#include <openvdb/openvdb.h>

namespace geokit {

// Signed distances, in a band of `half_width`, from the surface where the values are `isovalue`. With `keeps_band`,
// active voxels keep their values and only new ones are computed (isovalue must then be 0). Values are in voxels, and so
// is the transform.
template<typename GridT>
void redistance(GridT& grid, double half_width, double isovalue, bool keeps_band);

extern template void redistance(openvdb::FloatGrid&, double, double, bool);
extern template void redistance(openvdb::DoubleGrid&, double, double, bool);

} // namespace geokit
