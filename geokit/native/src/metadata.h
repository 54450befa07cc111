// Metadata of OpenVDB grids.
#pragma once

#include "metadata_item.h"

#include <openvdb/Grid.h>

#include <vector>

namespace geokit {

// What belongs to the grid. Left out is what the NanoVDB buffer holds (name; class where it survives) and what only
// describes how the grid lay in its file (statistics, half precision), which writing makes anew.
std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid);

// Sets items on the grid, over those that are there. Throws BridgeError("input") for bytes of the wrong length.
void set_metadata(openvdb::GridBase& grid, const std::vector<MetadataItem>& items);

} // namespace geokit
