// Bytes that end where their page does: one byte beyond them ends the process, also in libraries without a sanitizer.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>

#include <sys/mman.h>
#include <unistd.h>

class Exact {
public:
    // `alignment` of the first byte; up to that many bytes behind the last one are then not watched.
    explicit Exact(size_t size, size_t alignment = 1) : size_(size)
    {
        const size_t page = size_t(::sysconf(_SC_PAGESIZE));
        mapped_ = (size + alignment + page - 1) / page * page + page;
        void* const map = ::mmap(nullptr, mapped_, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (map == MAP_FAILED) std::abort();
        map_ = static_cast<uint8_t*>(map);
        uint8_t* const end = map_ + mapped_ - page;
        ::mprotect(end, page, PROT_NONE);
        data_ = end - (size + alignment - 1) / alignment * alignment;
    }
    Exact(const uint8_t* from, size_t size, size_t alignment = 1) : Exact(size, alignment)
    {
        if (size) std::memcpy(data_, from, size);
    }
    Exact(const Exact&) = delete;
    Exact& operator=(const Exact&) = delete;
    ~Exact() { ::munmap(map_, mapped_); }

    uint8_t* data() { return data_; }
    const uint8_t* data() const { return data_; }
    size_t size() const { return size_; }

private:
    uint8_t *map_ = nullptr, *data_ = nullptr;
    size_t size_, mapped_ = 0;
};
