// Signed distances from the zero set of a level set, which stays where it is.
#pragma once

#include <openvdb/openvdb.h>

namespace geokit {

// See redistance() in operations.h. Values are in voxels, and so is the transform.
template<typename GridT>
void redistance(GridT& grid, double half_width, double isovalue, bool keeps_band);

extern template void redistance(openvdb::FloatGrid&, double, double, bool);
extern template void redistance(openvdb::DoubleGrid&, double, double, bool);

} // namespace geokit
