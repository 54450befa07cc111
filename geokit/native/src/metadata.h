// Metadata of OpenVDB grids.
#pragma once

#include "metadata_item.h"

#include <openvdb/Grid.h>

#include <vector>

namespace geokit {

// Metadata that belongs to the grid. Left out are the items that the NanoVDB buffer holds (name; class if it survives)
// and those that only describe the grid in its file (statistics, half precision), which are computed again on writing.
std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid);

// Sets items on the grid, replacing existing ones. Throws BridgeError("input") for bytes of the wrong length.
void set_metadata(openvdb::GridBase& grid, const std::vector<MetadataItem>& items);

} // namespace geokit
