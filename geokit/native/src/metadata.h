// Metadata of OpenVDB grids.
#pragma once

#include "metadata_item.h"

#include <openvdb/Grid.h>

#include <vector>

namespace geokit {

// Metadata that belongs to the grid. Left out are the items that the NanoVDB buffer holds (name; class if it survives)
// and those that only describe the grid in its file (statistics), which are computed again on writing. That values have
// 16 bits is kept, that they have not goes without saying.
std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid);

// All metadata of a file.
std::vector<MetadataItem> metadata_of(const openvdb::MetaMap& file);

// Sets items of a grid or a file, replacing existing ones. Throws BridgeError("input") for bytes of the wrong length.
void set_metadata(openvdb::MetaMap& target, const std::vector<MetadataItem>& items);

} // namespace geokit
