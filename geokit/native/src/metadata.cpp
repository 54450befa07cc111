#include "vdb_file.h"

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
    return name == GridBase::META_FILE_BBOX_MIN || name == GridBase::META_FILE_BBOX_MAX
        || name == GridBase::META_FILE_COMPRESSION || name == GridBase::META_FILE_MEM_BYTES
        || name == GridBase::META_FILE_VOXEL_COUNT || name == GridBase::META_FILE_DELAYED_LOAD;
}

template<typename Keep>
std::vector<MetadataItem> items_of(const openvdb::MetaMap& map, Keep&& keep)
{
    std::vector<MetadataItem> items;
    for (auto it = map.beginMeta(); it != map.endMeta(); ++it) {
        if (!it->second || !keep(it->first)) continue;
        items.push_back({it->first, it->second->typeName(), bytes_of(*it->second)});
    }
    return items;
}

} // namespace

std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid)
{
    using openvdb::GridBase;
    return items_of(grid, [&](const std::string& name) {
        if (describes_the_file(name) || name == GridBase::META_GRID_NAME) return false;
        if (name == GridBase::META_SAVE_HALF_FLOAT) return grid.saveFloatAsHalf();
        // A class that NanoVDB's converter does not allow for this type is stored here instead.
        return name != GridBase::META_GRID_CLASS || class_after_round_trip(grid) != grid.getGridClass();
    });
}

std::vector<MetadataItem> metadata_of(const openvdb::MetaMap& file)
{
    return items_of(file, [](const std::string&) { return true; });
}

void set_metadata(openvdb::MetaMap& target, const std::vector<MetadataItem>& items)
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
        target.removeMeta(item.name); // insertMeta() refuses to change a type
        target.insertMeta(item.name, *metadata);
    }
}

} // namespace geokit
