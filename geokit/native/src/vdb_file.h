// Reading .vdb files, with checks that OpenVDB's own io::File does not make, and writing them, with the errors that it
// ignores.
#pragma once

#include "convert.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#include <istream>
#include <memory>
#include <optional>

namespace geokit {

// Metadata that belongs to the grid. Left out are the items that the NanoVDB buffer holds (name; class if it survives)
// and those that only describe the grid in its file (statistics), which are computed again on writing. That values have
// 16 bits is kept, that they have not goes without saying.
std::vector<MetadataItem> metadata_of(const openvdb::GridBase& grid);

// All metadata of a file.
std::vector<MetadataItem> metadata_of(const openvdb::MetaMap& file);

// Sets items of a grid or a file, replacing existing ones. Throws BridgeError("input") for bytes of the wrong length.
void set_metadata(openvdb::MetaMap& target, const std::vector<MetadataItem>& items);

// One grid of a file, as described by its header.
struct GridHeader {
    std::string name;
    std::string grid_type;           // "Tree_float_5_4_3"
    std::string grid_class;          // "level set", "fog volume", "staggered", "unknown"
    std::optional<Affine> transform; // none for a frustum
    std::vector<MetadataItem> metadata;
    std::optional<MetadataItem> background;    // only from inspect()
    std::optional<int64_t> active_voxel_count; // where the file says
    std::optional<openvdb::CoordBBox> index_bounds;
    std::string compression;
    bool is_half = false;
    bool is_convertible = false;
    uint64_t byte_count = 0; // in the file
};

// A grid that has been read: its NanoVDB buffer, in memory or in `path`.
struct ReadGrid {
    GridHeader header;
    MappedBuffer buffer;
    uint64_t size = 0;
    std::string path;
};

// An open .vdb file. OpenVDB's io::File ignores the state of its stream, so a truncated or damaged file can load as
// whatever was in memory. This reader uses the same parts of OpenVDB (io::Archive, io::GridDescriptor) on a stream that
// throws at a premature end, and checks that every grid ends where its descriptor says. It does NOT make OpenVDB safe:
// untrusted files are read in a separate process.
class VdbFile : private openvdb::io::Archive {
public:
    // Throws BridgeError("access") or ("damaged").
    explicit VdbFile(const std::string& path);

    // Metadata of the file itself.
    const std::vector<MetadataItem>& metadata() const { return metadata_; }

    // Headers of all grids, no voxels.
    std::vector<GridHeader> inspect();

    // Reads the named grids in the file's order (all grids of a name that occurs twice; "name[1]" for one of them), or
    // every grid if `names` is empty. With a spool folder the buffers go into files in it ("0", "1", ...), whose sizes
    // may sum to `spool_limit`, and are unmapped. Throws BridgeError("missing"), ("unsupported"), ("damaged").
    std::vector<ReadGrid> read(
        const std::vector<std::string>& names, const std::string& spool = "", uint64_t spool_limit = UINT64_MAX);

    // Reads the grid of points called `name`, or the only one if it is empty. Throws BridgeError("missing"),
    // ("damaged").
    openvdb::GridBase::Ptr read_points(const std::string& name);

private:
    struct Entry {
        openvdb::io::GridDescriptor descriptor;
        openvdb::GridBase::Ptr grid; // only where the file has no offsets and had to be read in one go
    };

    void read_descriptors();
    void read_version();
    openvdb::io::GridDescriptor read_descriptor();
    void require_inside(const openvdb::io::GridDescriptor& descriptor) const;
    std::vector<size_t> select(const std::vector<std::string>& names) const;
    std::string display_name(size_t i) const;
    openvdb::GridBase::Ptr read_grid(size_t i);
    GridHeader read_header(size_t i);
    GridHeader describe(const openvdb::GridBase& grid, size_t i) const;

    std::vector<char> stream_buffer_;
    openvdb::io::StreamMetadata::Ptr stream_metadata_ = std::make_shared<openvdb::io::StreamMetadata>();
    PulsedFile buffer_;
    std::istream stream_{&buffer_};
    int64_t file_size_ = 0;
    std::vector<MetadataItem> metadata_;
    std::vector<Entry> entries_;
};

// Adds the metadata that OpenVDB adds on writing, and writes the grids into a new file with `metadata` of its own.
// Throws BridgeError("input") for an unknown compression, and ("access").
void save_grids(const std::string& path, const openvdb::GridPtrVec& grids, const std::string& compression,
    const openvdb::MetaMap& metadata = {});

} // namespace geokit
