// Page-aligned, zero-initialized memory, private to the process or backed by a file.
#pragma once

#include <cstdint>
#include <string>

namespace geokit {

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

} // namespace geokit
