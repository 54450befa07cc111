// One OpenVDB metadata value in OpenVDB's own serialized form: exact for every type, known or unknown.
#pragma once

#include <string>

namespace geokit {

struct MetadataItem {
    std::string name;
    std::string type;  // OpenVDB's name of the type: "string", "float", "vec3s", ...
    std::string bytes; // the value as it lies in a .vdb file, little-endian
};

} // namespace geokit
