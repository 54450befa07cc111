#include "metadata.h"

#include "convert.h"
#include "errors.h"

#include <openvdb/Metadata.h>

#include <sstream>

namespace geokit {
namespace {

std::string bytes_of(const openvdb::Metadata& item)
{
    std::ostringstream stream(std::ios::binary);
    item.write(stream);
    return stream.str().substr(sizeof(openvdb::Index32)); // without the length in front
}

bool describes_the_file(const std::string& name)
{
    using openvdb::GridBase;
    return name == GridBase::META_SAVE_HALF_FLOAT || name == GridBase::META_FILE_BBOX_MIN
        || name == GridBase::META_FILE_BBOX_MAX || name == GridBase::META_FILE_COMPRESSION
        || name == GridBase::META_FILE_MEM_BYTES || name == GridBase::META_FILE_VOXEL_COUNT
        || name == GridBase::META_FILE_DELAYED_LOAD;
}

} // namespace

std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid)
{
    using openvdb::GridBase;
    std::vector<MetadataItem> items;
    for (auto it = grid.beginMeta(); it != grid.endMeta(); ++it) {
        const std::string& name = it->first;
        if (!it->second || describes_the_file(name) || name == GridBase::META_GRID_NAME) continue;
        // A class that NanoVDB's converter does not allow for this type is stored here instead.
        if (name == GridBase::META_GRID_CLASS && class_after_round_trip(grid) == grid.getGridClass()) continue;
        items.push_back({name, it->second->typeName(), bytes_of(*it->second)});
    }
    return items;
}

void set_metadata(openvdb::GridBase& grid, const std::vector<MetadataItem>& items)
{
    for (const auto& item : items) {
        const bool is_known = openvdb::Metadata::isRegisteredType(item.type);
        const auto metadata = is_known ? openvdb::Metadata::createMetadata(item.type)
                                       : openvdb::Metadata::Ptr(new openvdb::UnknownMetadata(item.type));
        if (is_known && item.type != "string" && item.bytes.size() != metadata->size()) {
            throw BridgeError("input",
                "metadata '" + item.name + "' of type " + item.type + " needs " + std::to_string(metadata->size())
                    + " bytes, not " + std::to_string(item.bytes.size()));
        }
        const auto length = openvdb::Index32(item.bytes.size());
        std::istringstream stream(
            std::string(reinterpret_cast<const char*>(&length), sizeof length) + item.bytes, std::ios::binary);
        metadata->read(stream);
        grid.removeMeta(item.name); // insertMeta() refuses to change a type
        grid.insertMeta(item.name, *metadata);
    }
}

} // namespace geokit
