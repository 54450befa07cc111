// Functions for the bindings, in addition to mesh.h and write.h. Includes no OpenVDB header: see CMakeLists.txt on
// visibility.
#pragma once

#include "buffer.h"
#include "errors.h"

#include <string>
#include <vector>

namespace geokit {

// Reads a trusted file (see VdbFile::read) into memory. Returns the JSON of json.h; the buffers are in the same order.
std::string read_vdb(
    const std::string& path, const std::vector<std::string>& names, std::vector<MappedBuffer>& buffers);

// {"error": {"kind": ..., "message": ..., "names": [...]}}
std::string to_json(const BridgeError& error);

// Versions of the libraries with which the bridge was built.
std::string openvdb_version();
std::string nanovdb_version();

} // namespace geokit
