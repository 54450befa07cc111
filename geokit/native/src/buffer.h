// Page-aligned memory that starts as zeros, private to the process or backed by a file.
#pragma once

#include <cstdint>
#include <string>

namespace geokit {

// Satisfies NanoVDB's BufferT, so that its converter writes a grid straight into the file that another process maps:
// no copy. Fresh pages are zero, which NanoVDB's HostBuffer does not promise: the bytes that no member covers come out
// equal in every run, and nothing of this process's memory leaks into a file.
class MappedBuffer {
public:
    MappedBuffer() = default;
    MappedBuffer(MappedBuffer&& other) noexcept;
    MappedBuffer& operator=(MappedBuffer&& other) noexcept;
    MappedBuffer(const MappedBuffer&) = delete;
    MappedBuffer& operator=(const MappedBuffer&) = delete;
    ~MappedBuffer() { clear(); }

    // An empty buffer whose only use is as the `context` of create().
    static MappedBuffer in_file(std::string path);

    // NanoVDB calls this. Allocates in the file that `context` names, else in memory.
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
