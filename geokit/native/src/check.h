// Structural check of a NanoVDB buffer, before any code follows its offsets.
#pragma once

#include <cstdint>

namespace geokit {

// Throws BridgeError("damaged") unless `data` holds exactly one grid whose nodes, root table, blind data and name all
// lie inside `size` bytes, and BridgeError("unsupported") for a type that the bridge cannot convert. Of values only
// bools are checked. Takes a few milliseconds for a grid of some hundred megabytes, because only inner nodes and leaf
// headers are read.
void check_nanovdb(const uint8_t* data, uint64_t size);

} // namespace geokit
