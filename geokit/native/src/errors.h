// The one exception type that leaves the bridge on purpose. `kind` decides which Python exception it becomes.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

namespace geokit {

// damaged      the file or buffer is not what it should be
// unsupported  a grid that NanoVDB or OpenVDB cannot represent
// missing      no grid of that name; `names` holds those that are there
// memory       more memory was needed than there is or than was allowed
// spool        the folder for results is full
// input        an argument that cannot be used
// access       the file cannot be opened, read or written
struct BridgeError : std::runtime_error {
    BridgeError(std::string kind_, const std::string& message, std::vector<std::string> names_ = {})
        : std::runtime_error(message), kind(std::move(kind_)), names(std::move(names_))
    {}
    std::string kind;
    std::vector<std::string> names;
};

} // namespace geokit
