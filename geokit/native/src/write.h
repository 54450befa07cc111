// Writing .vdb files.
#pragma once

#include "metadata_item.h"

#include <cstdint>
#include <string>
#include <vector>

namespace geokit {

struct WriteGrid {
    const uint8_t* nanovdb; // passed check_nanovdb()
    std::vector<MetadataItem> metadata;
};

// Writes the grids into a new file, which has `metadata` of its own. `compression` is "none", "zip" or "blosc"; the last
// two also omit inactive values that follow from the background. `half` stores floats and doubles with 16 bits, and so
// are those of a grid whose metadata ask for it, if that changes none. Throws BridgeError("input"), ("unsupported") or
// ("access").
void write_vdb(const std::string& path, const std::vector<WriteGrid>& grids, const std::vector<MetadataItem>& metadata,
    const std::string& compression, bool half);

} // namespace geokit
