// Results of reading as JSON: the form in which both the worker and the extension pass them to Python.
#pragma once

#include "bridge.h"
#include "read.h"

#include <string>
#include <vector>

namespace geokit {

// {"grids": [{"name": ..., ...}, ...]}; numbers keep all their bits, metadata is hexadecimal.
std::string to_json(const std::vector<GridHeader>& headers);
std::string to_json(const std::vector<ReadGrid>& grids);

} // namespace geokit
