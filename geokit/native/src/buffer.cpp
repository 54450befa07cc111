#include "bridge.h"

#include <cerrno>
#include <cstring>
#include <fcntl.h>
#include <new>
#include <sys/mman.h>
#include <unistd.h>

namespace geokit {

MappedBuffer::MappedBuffer(MappedBuffer&& other) noexcept { *this = std::move(other); }

MappedBuffer& MappedBuffer::operator=(MappedBuffer&& other) noexcept
{
    if (this != &other) {
        clear();
        path_ = std::move(other.path_);
        data_ = std::exchange(other.data_, nullptr);
        size_ = std::exchange(other.size_, 0);
    }
    return *this;
}

MappedBuffer MappedBuffer::in_file(std::string path)
{
    MappedBuffer context;
    context.path_ = std::move(path);
    return context;
}

MappedBuffer MappedBuffer::create(uint64_t size, const MappedBuffer* context)
{
    MappedBuffer result;
    if (size == 0) return result;
    const bool in_memory = context == nullptr || context->path_.empty();
    void* address = MAP_FAILED;
    if (in_memory) {
        address = ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    } else {
        const int file = ::open(context->path_.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
        if (file < 0) { throw BridgeError("spool", context->path_ + ": " + std::strerror(errno)); }
        // Reserve the blocks now: a mapped page that the file system cannot provide later raises a bus error.
        const int failure = ::posix_fallocate(file, 0, static_cast<off_t>(size));
        if (failure == 0) { address = ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0); }
        ::close(file);
        if (failure == EFBIG) throw std::bad_alloc(); // the process may not write as much
        if (failure != 0) { throw BridgeError("spool", context->path_ + ": " + std::strerror(failure)); }
    }
    if (address == MAP_FAILED) throw std::bad_alloc();
    result.data_ = static_cast<uint8_t*>(address);
    result.size_ = size;
    return result;
}

void MappedBuffer::clear()
{
    if (data_ != nullptr) ::munmap(data_, size_);
    data_ = nullptr;
    size_ = 0;
}

} // namespace geokit
