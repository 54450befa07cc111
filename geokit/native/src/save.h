// Writing OpenVDB's grids into a file, with errors that io::File ignores.
#pragma once

#include <openvdb/Grid.h>

#include <string>

namespace geokit {

// Adds the metadata that OpenVDB adds on writing, and writes the grids into a new file with `metadata` of its own.
// Throws BridgeError("input") for an unknown compression, and ("access").
void save_grids(const std::string& path, const openvdb::GridPtrVec& grids, const std::string& compression,
    const openvdb::MetaMap& metadata = {});

} // namespace geokit
