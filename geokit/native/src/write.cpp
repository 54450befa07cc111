#include "nano_types.h"
#include "vdb_file.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/Compression.h>

#include <cerrno>
#include <cstring>

namespace geokit {
namespace {

uint32_t compression_flags(const std::string& name)
{
    using openvdb::io::Archive;
    if (name == "none") return openvdb::io::COMPRESS_NONE;
    if (name == "zip" && Archive::hasZLibCompression()) {
        return openvdb::io::COMPRESS_ZIP | openvdb::io::COMPRESS_ACTIVE_MASK;
    }
    if (name == "blosc" && Archive::hasBloscCompression()) {
        return openvdb::io::COMPRESS_BLOSC | openvdb::io::COMPRESS_ACTIVE_MASK;
    }
    throw BridgeError(
        "input", "compression '" + name + "' is not one of none, zip, blosc, or OpenVDB was built without it");
}

// io::File ignores errors of its stream, so a separate stream is used that throws when the disk is full.
class VdbWriter : public openvdb::io::Archive {
public:
    // Adds the metadata that OpenVDB adds on writing. OpenVDB would copy the grid first, and a copy rounds the
    // transform.
    void add_statistics(openvdb::GridBase& grid) const
    {
        const auto grid_class = grid.getGridClass();
        uint32_t flags = compression();
        // OpenVDB does not apply ZIP to these two.
        if (grid_class == openvdb::GRID_LEVEL_SET || grid_class == openvdb::GRID_FOG_VOLUME) {
            flags &= ~uint32_t(openvdb::io::COMPRESS_ZIP);
        }
        grid.addStatsMetadata();
        grid.insertMeta(
            openvdb::GridBase::META_FILE_COMPRESSION, openvdb::StringMetadata(openvdb::io::compressionToString(flags)));
    }

    void save(std::ostream& stream, const openvdb::GridCPtrVec& grids, const openvdb::MetaMap& metadata) const
    { openvdb::io::Archive::write(stream, grids, /*seekable=*/true, metadata); }
};

bool take_vec3i_mark(std::vector<MetadataItem>& items)
{
    for (auto it = items.begin(); it != items.end(); ++it) {
        if (it->name != "geokit:value_type") continue;
        const bool is_vec3i = it->bytes == "vec3i";
        items.erase(it);
        return is_vec3i;
    }
    return false;
}

// Whether a value has the same bits after it was stored with 16 of them. OpenVDB stores all other types whole.
template<typename T>
bool is_half(const T& value)
{
    if constexpr (!openvdb::io::RealToHalf<T>::isReal) return true;
    else {
        const T stored = openvdb::io::truncateRealToHalf(value);
        return std::memcmp(&stored, &value, sizeof value) == 0;
    }
}

template<typename T>
bool is_half(const nanovdb::Vec3<T>& value)
{ return is_half(value[0]) && is_half(value[1]) && is_half(value[2]); }

template<typename Node>
bool is_half_node(const Node& node)
{
    if constexpr (Node::LEVEL == 0) {
        for (uint32_t i = 0; i < Node::SIZE; ++i) {
            if (!is_half(node.getValue(i))) return false;
        }
    } else {
        pulse_if_any();
        for (uint32_t i = 0; i < Node::SIZE; ++i) {
            const bool is_exact = node.childMask().isOn(i) ? is_half_node(*node.data()->getChild(i))
                                                           : is_half(node.data()->mTable[i].value);
            if (!is_exact) return false;
        }
    }
    return true;
}

// Whether the file can hold all values with 16 bits. Tiles of the root have all of theirs in any case.
bool is_half_grid(const uint8_t* data)
{
    return dispatch(reinterpret_cast<const nanovdb::GridData*>(data)->mGridType, [&](auto tag) {
        using BuildT = typename decltype(tag)::Type;
        const auto& root = reinterpret_cast<const nanovdb::NanoGrid<BuildT>*>(data)->tree().root();
        if (!is_half(root.background())) return false;
        for (uint32_t i = 0; i < root.data()->mTableSize; ++i) {
            const auto* tile = root.data()->tile(i);
            if (tile->isChild() && !is_half_node(*root.data()->getChild(tile))) return false;
        }
        return true;
    });
}

} // namespace

void write_vdb(const std::string& path, const std::vector<WriteGrid>& sources,
    const std::vector<MetadataItem>& metadata, const std::string& compression, bool half)
{
    initialize();
    openvdb::GridPtrVec grids;
    for (const auto& source : sources) {
        auto items = source.metadata;
        const bool as_vec3i = take_vec3i_mark(items);
        const auto grid = to_openvdb(source.nanovdb, as_vec3i);
        set_metadata(*grid, items);
        grid->setSaveFloatAsHalf(half || (grid->saveFloatAsHalf() && is_half_grid(source.nanovdb)));
        grids.push_back(grid);
    }
    openvdb::MetaMap of_file;
    set_metadata(of_file, metadata);
    save_grids(path, grids, compression, of_file);
}

void save_grids(const std::string& path, const openvdb::GridPtrVec& grids, const std::string& compression,
    const openvdb::MetaMap& metadata)
{
    VdbWriter writer;
    writer.setCompression(compression_flags(compression));
    writer.setGridStatsMetadataEnabled(false);
    for (const auto& grid : grids) writer.add_statistics(*grid);
    try {
        std::vector<char> buffer(size_t(1) << 20);
        PulsedFile file;
        file.pubsetbuf(buffer.data(), std::streamsize(buffer.size()));
        std::ostream stream(&file);
        stream.exceptions(std::ios::failbit | std::ios::badbit);
        if (file.open(path, std::ios::out | std::ios::binary | std::ios::trunc) == nullptr)
            stream.setstate(std::ios::failbit);
        writer.save(stream, {grids.begin(), grids.end()}, metadata);
        if (file.close() == nullptr) stream.setstate(std::ios::failbit);
    } catch (const std::ios_base::failure&) {
        throw BridgeError("access", std::string("writing failed (") + std::strerror(errno) + ")");
    }
}

} // namespace geokit
