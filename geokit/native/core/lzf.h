// LZF, the compression of .pcd files.
//
// A control byte below 32 announces that many literals plus one. Any other control byte is a back reference: its upper
// three bits are the length minus two (for 7 the next byte is added), its lower five bits and the next byte the
// distance minus one.
#pragma once

#include <cstdint>

namespace geokit {

// Decompresses `packed` into `out`. Returns -1, or the first byte of `packed` that is damaged: a reference before the
// beginning, a run beyond the end, or a size other than that of `out`. The contents of `out` are then undefined.
std::int64_t lzf_decompress(const std::uint8_t* packed, std::int64_t packed_size, std::uint8_t* out, std::int64_t size);

// Largest size that lzf_compress writes for `size` bytes: each 32 literals cost one more, and the last run may be
// short.
constexpr std::int64_t lzf_bound(std::int64_t size) { return size + size / 32 + 2; }

// Compresses `plain` into `out`, which has room for lzf_bound(size) bytes; returns the number of bytes written.
std::int64_t lzf_compress(const std::uint8_t* plain, std::int64_t size, std::uint8_t* out);

} // namespace geokit
