// What the bridge offers without OpenVDB's headers, for the bindings and the worker; operations.h and points.h have the
// rest. See CMakeLists.txt on visibility.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace geokit {

// The only exception type that leaves the bridge intentionally. `kind` decides which Python exception it becomes.
//
// damaged      the file or buffer is damaged
// unsupported  NanoVDB or OpenVDB cannot represent the grid
// points       the grid holds points, which read_points() reads
// missing      there is no grid of that name; `names` lists those in the file
// memory       not enough memory, or the memory limit was exceeded
// spool        the folder for results is full
// input        an argument is invalid
// access       the file cannot be opened, read or written
struct BridgeError : std::runtime_error {
    BridgeError(std::string kind_, const std::string& message, std::vector<std::string> names_ = {})
        : std::runtime_error(message), kind(std::move(kind_)), names(std::move(names_))
    {}
    std::string kind;
    std::vector<std::string> names;
};

// One OpenVDB metadata value in OpenVDB's own serialized form: exact for every type, known or unknown.
struct MetadataItem {
    std::string name;
    std::string type;  // OpenVDB's name of the type: "string", "float", "vec3s", ...
    std::string bytes; // the value as it lies in a .vdb file, little-endian
};

// Page-aligned, zero-initialized memory, private to the process or backed by a file.
//
// Satisfies NanoVDB's BufferT, so that its converter writes a grid directly into the file that another process maps,
// without a copy. Fresh pages are zero, which NanoVDB's HostBuffer does not guarantee. So padding bytes are equal in
// every run, and no memory of this process leaks into a file.
class MappedBuffer {
public:
    MappedBuffer() = default;
    MappedBuffer(MappedBuffer&& other) noexcept;
    MappedBuffer& operator=(MappedBuffer&& other) noexcept;
    MappedBuffer(const MappedBuffer&) = delete;
    MappedBuffer& operator=(const MappedBuffer&) = delete;
    ~MappedBuffer() { clear(); }

    // An empty buffer that only serves as the `context` of create().
    static MappedBuffer in_file(std::string path);

    // Called by NanoVDB. Allocates in the file that `context` names, else in memory.
    static MappedBuffer create(uint64_t size, const MappedBuffer* context = nullptr);

    uint8_t* data() { return data_; }
    const uint8_t* data() const { return data_; }
    uint64_t size() const { return size_; }
    void clear();

private:
    std::string path_;
    uint8_t* data_ = nullptr;
    uint64_t size_ = 0;
};

// Structural check of a NanoVDB buffer, before any code follows its offsets.
//
// Throws BridgeError("damaged") unless `data` holds exactly one grid whose nodes, root table, blind data and name all
// lie inside `size` bytes, and BridgeError("unsupported") for a type that the bridge cannot convert. Of values only
// bools are checked. Takes a few milliseconds for a grid of some hundred megabytes, because only inner nodes and leaf
// headers are read.
void check_nanovdb(const uint8_t* data, uint64_t size);

// Reads a trusted file (see VdbFile::read) into memory. The buffers are in the order of the JSON:
// {"grids": [{"name": ..., ...}, ...], "metadata": [...]}; numbers keep all their bits, metadata is hexadecimal.
std::string read_vdb(
    const std::string& path, const std::vector<std::string>& names, std::vector<MappedBuffer>& buffers);

// For the worker: the headers of all grids, and reading into files of the folder `spool` (see VdbFile), as the same JSON.
std::string inspect_vdb(const std::string& path);
std::string spool_vdb(
    const std::string& path, const std::vector<std::string>& names, const std::string& spool, uint64_t spool_limit);

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

// {"error": {"kind": ..., "message": ..., "names": [...]}}
std::string to_json(const BridgeError& error);

// Versions of the libraries with which the bridge was built.
std::string openvdb_version();
std::string nanovdb_version();

// Other facts for bug reports, by name: "tbb", the version that is loaded, and "compiler".
std::vector<std::pair<std::string, std::string>> build_facts();

} // namespace geokit
