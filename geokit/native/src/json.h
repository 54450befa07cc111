// Results of reading as JSON: the form in which both the worker and the extension pass them to Python.
#pragma once

#include "bridge.h"
#include "read.h"

#include <string>
#include <vector>

namespace geokit {

// {"grids": [{"name": ..., ...}, ...], "metadata": [...]}; numbers keep all their bits, metadata is hexadecimal.
std::string to_json(const std::vector<GridHeader>& headers, const std::vector<MetadataItem>& file_metadata);
std::string to_json(const std::vector<ReadGrid>& grids, const std::vector<MetadataItem>& file_metadata);

} // namespace geokit
