#include "bridge.h"

#include "vdb_file.h"

#include <nanovdb/NanoVDB.h>
#include <openvdb/version.h>
#include <tbb/version.h>

#include <cstdio>

namespace geokit {
namespace {

// Bytes beyond ASCII are written unchanged, because names in a .vdb file need not be UTF-8.
std::string quoted(const std::string& text)
{
    std::string out = "\"";
    for (const unsigned char c : text) {
        if (c == '"' || c == '\\') {
            out += '\\';
            out += char(c);
        } else if (c < 0x20) {
            char escape[8];
            std::snprintf(escape, sizeof escape, "\\u%04x", c);
            out += escape;
        } else {
            out += char(c);
        }
    }
    return out + "\"";
}

std::string hexadecimal(const std::string& bytes)
{
    static const char digits[] = "0123456789abcdef";
    std::string out = "\"";
    for (const unsigned char c : bytes) {
        out += digits[c >> 4];
        out += digits[c & 15];
    }
    return out + "\"";
}

std::string number(double value)
{
    char text[32];
    std::snprintf(text, sizeof text, "%.17g", value);
    return text;
}

std::string item_json(const MetadataItem& item)
{
    return "{\"name\": " + quoted(item.name) + ", \"type\": " + quoted(item.type)
        + ", \"hex\": " + hexadecimal(item.bytes) + "}";
}

std::string metadata_json(const std::vector<MetadataItem>& items)
{
    std::string out = "\"metadata\": [";
    for (size_t i = 0; i < items.size(); ++i) out += (i ? ", " : "") + item_json(items[i]);
    return out + "]";
}

std::string transform_json(const Affine& affine)
{
    std::string out = "[";
    for (int i = 0; i < 3; ++i) {
        for (double value : affine.linear[i]) out += number(value) + ", ";
        out += number(affine.offset[i]) + ", ";
    }
    return out + "0, 0, 0, 1]";
}

std::string bounds_json(const openvdb::CoordBBox& bounds)
{
    std::string out = "[";
    for (int i = 0; i < 3; ++i) out += std::to_string(bounds.min()[i]) + ", ";
    for (int i = 0; i < 3; ++i) out += std::to_string(bounds.max()[i]) + (i < 2 ? ", " : "]");
    return out;
}

std::string fields(const GridHeader& header)
{
    std::string out = "\"name\": " + quoted(header.name);
    out += ", \"grid_type\": " + quoted(header.grid_type);
    out += ", \"grid_class\": " + quoted(header.grid_class);
    out += ", \"transform\": " + (header.transform ? transform_json(*header.transform) : "null");
    out += ", \"background\": " + (header.background ? item_json(*header.background) : "null");
    out += ", \"active_voxel_count\": "
        + (header.active_voxel_count ? std::to_string(*header.active_voxel_count) : std::string("null"));
    out += ", \"index_bounds\": " + (header.index_bounds ? bounds_json(*header.index_bounds) : "null");
    out += ", \"compression\": " + quoted(header.compression);
    out += std::string(", \"half\": ") + (header.is_half ? "true" : "false");
    out += std::string(", \"convertible\": ") + (header.is_convertible ? "true" : "false");
    out += ", \"byte_count\": " + std::to_string(header.byte_count);
    return out + ", " + metadata_json(header.metadata);
}

template<typename T, typename Fields>
std::string list(const std::vector<T>& items, const std::vector<MetadataItem>& file_metadata, Fields&& fields_of)
{
    std::string out = "{\"grids\": [";
    for (size_t i = 0; i < items.size(); ++i) out += (i ? ", {" : "{") + fields_of(items[i]) + "}";
    return out + "], " + metadata_json(file_metadata) + "}";
}

std::string to_json(const std::vector<GridHeader>& headers, const std::vector<MetadataItem>& file_metadata)
{
    return list(headers, file_metadata, [](const GridHeader& header) { return fields(header); });
}

std::string to_json(const std::vector<ReadGrid>& grids, const std::vector<MetadataItem>& file_metadata)
{
    return list(grids, file_metadata, [](const ReadGrid& grid) {
        return fields(grid.header) + ", \"path\": " + quoted(grid.path) + ", \"size\": " + std::to_string(grid.size);
    });
}

std::string dotted(int major, int minor, int patch)
{ return std::to_string(major) + "." + std::to_string(minor) + "." + std::to_string(patch); }

} // namespace

std::string read_vdb(const std::string& path, const std::vector<std::string>& names, std::vector<MappedBuffer>& buffers)
{
    VdbFile file(path);
    auto grids = file.read(names);
    const auto json = to_json(grids, file.metadata());
    for (auto& grid : grids) buffers.push_back(std::move(grid.buffer));
    return json;
}

std::string inspect_vdb(const std::string& path)
{
    VdbFile file(path);
    return to_json(file.inspect(), file.metadata());
}

std::string spool_vdb(
    const std::string& path, const std::vector<std::string>& names, const std::string& spool, uint64_t spool_limit)
{
    VdbFile file(path);
    return to_json(file.read(names, spool, spool_limit), file.metadata());
}

std::string openvdb_version()
{
    return dotted(OPENVDB_LIBRARY_MAJOR_VERSION_NUMBER, OPENVDB_LIBRARY_MINOR_VERSION_NUMBER,
        OPENVDB_LIBRARY_PATCH_VERSION_NUMBER);
}

std::string nanovdb_version()
{ return dotted(NANOVDB_MAJOR_VERSION_NUMBER, NANOVDB_MINOR_VERSION_NUMBER, NANOVDB_PATCH_VERSION_NUMBER); }

std::vector<std::pair<std::string, std::string>> build_facts()
{
#ifdef __clang__
    const std::string compiler = "Clang ";
#else
    const std::string compiler = "GCC ";
#endif
    return {{"tbb", TBB_runtime_version()}, {"compiler", compiler + __VERSION__}};
}

std::string to_json(const BridgeError& error)
{
    std::string out = "{\"error\": {\"kind\": " + quoted(error.kind) + ", \"message\": " + quoted(error.what());
    out += ", \"names\": [";
    for (size_t i = 0; i < error.names.size(); ++i) out += (i ? ", " : "") + quoted(error.names[i]);
    return out + "]}}";
}

} // namespace geokit
