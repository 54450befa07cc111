#include "vdb_file.h"

#include <openvdb/io/Compression.h>
#include <openvdb/io/io.h>
#include <openvdb/version.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <map>
#include <sstream>

namespace geokit {
namespace {

// Large enough that a leaf's few kilobytes do not cost a system call each.
constexpr size_t kStreamBufferSize = size_t(1) << 20;

// Before the file's metadata: the magic number, the versions of the format and of the library, whether there are
// offsets, and an identifier of 36 characters.
constexpr int64_t kHeaderSize = 8 + 4 + 2 * 4 + 1 + 36;
constexpr int64_t kVersionOffset = 8;

// Every grid is given the file's metadata, so a small file of many items and many grids could fill the memory.
constexpr int64_t kMostMetadata = 1000000;

[[noreturn]] void damaged(const std::string& what) { throw BridgeError("damaged", what); }

// Exceptions of OpenVDB and the standard library during parsing mean that the bytes are not those of a .vdb file.
template<typename Step>
auto parsing(const char* what, Step&& step)
{
    try {
        return step();
    } catch (const BridgeError&) {
        throw;
    } catch (const std::bad_alloc&) {
        throw;
    } catch (const std::ios_base::failure&) {
        damaged(std::string(what) + " end before they should");
    } catch (const std::exception& error) {
        damaged(std::string(what) + " cannot be parsed (" + error.what() + ")");
    }
}

} // namespace

VdbFile::VdbFile(const std::string& path) : stream_buffer_(kStreamBufferSize)
{
    initialize();
    buffer_.pubsetbuf(stream_buffer_.data(), std::streamsize(stream_buffer_.size()));
    if (buffer_.open(path, std::ios::in | std::ios::binary | std::ios::ate) == nullptr)
        throw BridgeError("access", std::strerror(errno));
    file_size_ = int64_t(stream_.tellg());
    stream_.seekg(0);
    stream_.exceptions(std::ios::failbit | std::ios::badbit | std::ios::eofbit);
    parsing("its headers", [&] { read_descriptors(); });
}

void VdbFile::read_descriptors()
{
    namespace io = openvdb::io;
    io::setStreamMetadataPtr(stream_, stream_metadata_, /*transfer=*/false);
    read_version();
    setFormatVersion(stream_);
    setLibraryVersion(stream_);
    setDataCompression(stream_);
    openvdb::MetaMap file_metadata;
    file_metadata.readMeta(stream_);
    metadata_ = metadata_of(file_metadata);
    const int32_t count = readGridCount(stream_);
    if (count <= 0) damaged("it holds no grids");
    if (int64_t(metadata_.size()) > kMostMetadata / count) {
        damaged("it says that it has " + std::to_string(count) + " grids and " + std::to_string(metadata_.size())
            + " metadata of its own");
    }
    for (int32_t i = 0; i < count; ++i) {
        Entry entry{read_descriptor(), nullptr};
        if (inputHasGridOffsets()) {
            require_inside(entry.descriptor);
            stream_.seekg(entry.descriptor.getEndPos());
        } else {
            // Such a file was written to a pipe: the grids follow one another and can only be read in order.
            if (!openvdb::GridBase::isRegistered(entry.descriptor.gridType())) {
                throw BridgeError("unsupported",
                    "grid '" + entry.descriptor.gridName() + "' of type " + entry.descriptor.gridType()
                        + " cannot be read, nor what follows it in a file without offsets");
            }
            entry.grid = openvdb::GridBase::createGrid(entry.descriptor.gridType());
            readGrid(entry.grid, entry.descriptor, stream_);
        }
        entries_.push_back(std::move(entry));
    }
    if (inputHasGridOffsets()) return;
    NamedGridMap by_name;
    for (const auto& entry : entries_) by_name[entry.descriptor.uniqueName()] = entry.grid;
    for (const auto& entry : entries_) {
        if (entry.descriptor.isInstance()) connectInstance(entry.descriptor, by_name);
    }
}

// OpenVDB reads later versions too, but logs that to the stdout of whoever loads a file. geokit.native warns of them, so
// OpenVDB is shown its own version.
void VdbFile::read_version()
{
    std::string header(kHeaderSize, '\0');
    uint32_t version = 0;
    if (file_size_ >= kHeaderSize) {
        stream_.read(header.data(), kHeaderSize);
        std::memcpy(&version, header.data() + kVersionOffset, sizeof version);
    }
    if (version <= openvdb::OPENVDB_FILE_VERSION) {
        stream_.seekg(0);
        readHeader(stream_);
        return;
    }
    std::memcpy(header.data() + kVersionOffset, &openvdb::OPENVDB_FILE_VERSION, sizeof version);
    std::istringstream known(header);
    readHeader(known);
}

openvdb::io::GridDescriptor VdbFile::read_descriptor()
{
    openvdb::io::GridDescriptor descriptor;
    try {
        descriptor.read(stream_);
        return descriptor;
    } catch (const openvdb::LookupError&) {
        // OpenVDB does not know this type. The names were read but the offsets were not: continue with the offsets, so
        // that the other grids of the file can be read.
    }
    if (!is_plausible_type(descriptor.gridType())) damaged("it names a grid type that does not exist");
    int64_t offsets[3];
    stream_.read(reinterpret_cast<char*>(offsets), sizeof offsets);
    descriptor.setGridPos(offsets[0]);
    descriptor.setBlockPos(offsets[1]);
    descriptor.setEndPos(offsets[2]);
    return descriptor;
}

void VdbFile::require_inside(const openvdb::io::GridDescriptor& descriptor) const
{
    const int64_t here = int64_t(const_cast<std::istream&>(stream_).tellg());
    if (descriptor.getGridPos() < here || descriptor.getEndPos() < descriptor.getGridPos()) {
        damaged("the offsets of grid '" + descriptor.gridName() + "' make no sense");
    }
    if (descriptor.getEndPos() > file_size_) {
        damaged("grid '" + descriptor.gridName() + "' should end at byte " + std::to_string(descriptor.getEndPos())
            + ", but the file has " + std::to_string(file_size_));
    }
}

std::string VdbFile::display_name(size_t i) const
{ return openvdb::io::GridDescriptor::nameAsString(entries_[i].descriptor.uniqueName()); }

std::vector<size_t> VdbFile::select(const std::vector<std::string>& names) const
{
    std::vector<bool> wanted(entries_.size(), names.empty());
    for (const auto& name : names) {
        bool found = false;
        for (size_t i = 0; i < entries_.size(); ++i) {
            if (name == entries_[i].descriptor.gridName() || name == display_name(i)) wanted[i] = found = true;
        }
        if (!found) {
            std::vector<std::string> present;
            for (size_t k = 0; k < entries_.size(); ++k) present.push_back(display_name(k));
            throw BridgeError("missing", "no grid named '" + name + "'", present);
        }
    }
    std::vector<size_t> indices;
    for (size_t i = 0; i < entries_.size(); ++i) {
        if (wanted[i]) indices.push_back(i);
    }
    return indices;
}

openvdb::GridBase::Ptr VdbFile::read_grid(size_t i)
{
    const auto& entry = entries_[i];
    if (entry.grid) return entry.grid; // a copy would round the transform
    const auto& descriptor = entry.descriptor;
    auto grid = openvdb::GridBase::createGrid(descriptor.gridType());
    grid->setSaveFloatAsHalf(descriptor.saveFloatAsHalf());
    stream_.seekg(descriptor.getGridPos());
    readGrid(grid, descriptor, stream_);
    if (int64_t(stream_.tellg()) != descriptor.getEndPos()) {
        damaged("grid '" + descriptor.gridName() + "' does not end where the file says");
    }
    if (descriptor.isInstance()) {
        // Shares the tree of an earlier grid of the file, which cannot be an instance itself.
        for (const auto& parent : entries_) {
            if (parent.descriptor.uniqueName() != descriptor.instanceParentName()) continue;
            if (parent.descriptor.isInstance() || parent.descriptor.gridType() != descriptor.gridType()) break;
            grid->setTree(read_grid(size_t(&parent - entries_.data()))->baseTreePtr());
            return grid;
        }
        damaged("grid '" + descriptor.gridName() + "' shares the tree of a grid that is not there");
    }
    return grid;
}

std::vector<ReadGrid> VdbFile::read(
    const std::vector<std::string>& names, const std::string& spool, uint64_t spool_limit)
{
    const auto selected = select(names);
    for (size_t i : selected) {
        const auto& type = entries_[i].descriptor.gridType();
        if (holds_points(type)) { throw BridgeError("points", "grid '" + display_name(i) + "' holds points"); }
        if (!is_convertible(type)) {
            throw BridgeError(
                "unsupported", "grid '" + display_name(i) + "' of type " + type + " has no NanoVDB counterpart");
        }
    }
    std::vector<ReadGrid> results;
    uint64_t spooled = 0;
    for (size_t i : selected) {
        const std::string what = "the contents of grid '" + display_name(i) + "'";
        const auto grid = parsing(what.c_str(), [&] { return read_grid(i); });
        ReadGrid result;
        result.header = parsing(what.c_str(), [&] { return describe(*grid, i); });
        if (!result.header.transform) {
            throw BridgeError("unsupported",
                "grid '" + display_name(i) + "' has a frustum transform; only affine ones can be converted");
        }
        grid->setName(result.header.name);
        if (!spool.empty()) result.path = spool + "/" + std::to_string(results.size());
        result.buffer = parsing(what.c_str(), [&] { return to_nanovdb(grid, result.path); });
        result.size = result.buffer.size();
        if (!spool.empty()) {
            result.buffer.clear(); // the file has it; two grids need not be mapped at once
            spooled += result.size;
            if (spooled > spool_limit) throw std::bad_alloc();
        }
        results.push_back(std::move(result));
    }
    return results;
}

openvdb::GridBase::Ptr VdbFile::read_points(const std::string& name)
{
    std::vector<size_t> found;
    std::vector<std::string> all, of_points;
    for (size_t i = 0; i < entries_.size(); ++i) {
        all.push_back(display_name(i));
        if (!holds_points(entries_[i].descriptor.gridType())) continue;
        of_points.push_back(display_name(i));
        if (name.empty() || name == entries_[i].descriptor.gridName() || name == display_name(i)) found.push_back(i);
    }
    if (of_points.empty()) {
        throw BridgeError("missing", "holds no points but volumes, which geokit.volume.load reads", all);
    }
    if (found.empty()) throw BridgeError("missing", "no grid of points named '" + name + "'", of_points);
    if (name.empty() && found.size() > 1) {
        throw BridgeError("missing", "has several grids of points; choose one with grid=", of_points);
    }
    const std::string what = "the contents of grid '" + display_name(found[0]) + "'";
    return parsing(what.c_str(), [&] { return read_grid(found[0]); });
}

std::vector<GridHeader> VdbFile::inspect()
{
    std::vector<GridHeader> headers;
    for (size_t i = 0; i < entries_.size(); ++i) {
        headers.push_back(parsing("its headers", [&] { return read_header(i); }));
    }
    return headers;
}

GridHeader VdbFile::read_header(size_t i)
{
    const auto& entry = entries_[i];
    if (entry.grid) return describe(*entry.grid, i);
    const auto& descriptor = entry.descriptor;
    if (!openvdb::GridBase::isRegistered(descriptor.gridType())) {
        GridHeader header;
        header.name = descriptor.gridName();
        header.grid_type = descriptor.gridType();
        header.grid_class = "unknown";
        header.byte_count = uint64_t(descriptor.getEndPos() - descriptor.getGridPos());
        return header;
    }
    const auto grid = openvdb::GridBase::createGrid(descriptor.gridType());
    stream_.seekg(descriptor.getGridPos());
    readGridCompression(stream_);
    grid->readMeta(stream_);
    // Files older than this version (2012) store the voxels before the transform.
    if (openvdb::io::getFormatVersion(stream_) < openvdb::OPENVDB_FILE_VERSION_GRID_INSTANCING)
        return describe(*grid, i);
    grid->readTransform(stream_);
    auto header = describe(*grid, i);
    if (header.is_convertible && !descriptor.isInstance()) {
        // A tree begins with a count of buffers and the root's background value.
        int32_t buffer_count = 0;
        stream_.read(reinterpret_cast<char*>(&buffer_count), sizeof buffer_count);
        std::string type = grid->valueType();
        size_t size = 1; // bool and mask
        if (type == "mask") type = "bool";
        else if (type == "uint32") size = sizeof(uint32_t);
        else if (openvdb::Metadata::isRegisteredType(type)) size = openvdb::Metadata::createMetadata(type)->size();
        MetadataItem background{"background", type, std::string(size, '\0')};
        stream_.read(background.bytes.data(), std::streamsize(size));
        header.background = std::move(background);
    }
    return header;
}

GridHeader VdbFile::describe(const openvdb::GridBase& grid, size_t i) const
{
    using openvdb::GridBase;
    const auto& descriptor = entries_[i].descriptor;
    GridHeader header;
    header.name = descriptor.gridName();
    header.grid_type = descriptor.gridType();
    header.grid_class = GridBase::gridClassToString(grid.getGridClass());
    header.is_convertible = is_convertible(descriptor.gridType());
    header.is_half = descriptor.saveFloatAsHalf();
    header.byte_count = uint64_t(descriptor.getEndPos() - descriptor.getGridPos());
    if (grid.transform().isLinear()) header.transform = affine_of(grid.transform());
    header.metadata = metadata_of(grid);
    if (const auto text = grid.getMetadata<openvdb::StringMetadata>(GridBase::META_FILE_COMPRESSION)) {
        header.compression = text->value();
    }
    if (const auto count = grid.getMetadata<openvdb::Int64Metadata>(GridBase::META_FILE_VOXEL_COUNT)) {
        header.active_voxel_count = count->value();
    }
    const auto lower = grid.getMetadata<openvdb::Vec3IMetadata>(GridBase::META_FILE_BBOX_MIN);
    const auto upper = grid.getMetadata<openvdb::Vec3IMetadata>(GridBase::META_FILE_BBOX_MAX);
    if (lower && upper) header.index_bounds.emplace(openvdb::Coord(lower->value()), openvdb::Coord(upper->value()));
    if (descriptor.gridType() == openvdb::Name("Tree_vec3i_5_4_3")) {
        // The buffer will be vec3d; this entry makes the writer convert it back.
        header.metadata.push_back({"geokit:value_type", "string", "vec3i"});
    }
    return header;
}

} // namespace geokit
