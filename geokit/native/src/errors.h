// The only exception type that leaves the bridge intentionally. `kind` decides which Python exception it becomes.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

namespace geokit {

// damaged      the file or buffer is damaged
// unsupported  NanoVDB or OpenVDB cannot represent the grid
// points       the grid holds points, which read_points() reads
// missing      there is no grid of that name; `names` lists those in the file
// memory       not enough memory, or the memory limit was exceeded
// spool        the folder for results is full
// input        an argument is invalid
// access       the file cannot be opened, read or written
struct BridgeError : std::runtime_error {
    BridgeError(std::string kind_, const std::string& message, std::vector<std::string> names_ = {})
        : std::runtime_error(message), kind(std::move(kind_)), names(std::move(names_))
    {}
    std::string kind;
    std::vector<std::string> names;
};

} // namespace geokit
