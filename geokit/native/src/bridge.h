// Functions for the bindings, in addition to mesh.h and write.h. Includes no OpenVDB header: see CMakeLists.txt on
// visibility.
#pragma once

#include "buffer.h"
#include "errors.h"

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

namespace geokit {

// Reads a trusted file (see VdbFile::read) into memory. Returns the JSON of json.h; the buffers are in the same order.
std::string read_vdb(
    const std::string& path, const std::vector<std::string>& names, std::vector<MappedBuffer>& buffers);

// For the worker: the headers of all grids, and reading into files of the folder `spool` (see VdbFile). JSON of json.h.
std::string inspect_vdb(const std::string& path);
std::string spool_vdb(
    const std::string& path, const std::vector<std::string>& names, const std::string& spool, uint64_t spool_limit);

// {"error": {"kind": ..., "message": ..., "names": [...]}}
std::string to_json(const BridgeError& error);

// Versions of the libraries with which the bridge was built.
std::string openvdb_version();
std::string nanovdb_version();

// Other facts for bug reports, by name: "tbb", the version that is loaded, and "compiler".
std::vector<std::pair<std::string, std::string>> build_facts();

} // namespace geokit
