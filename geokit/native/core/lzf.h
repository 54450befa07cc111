// LZF, the compression of .pcd files.
//
// A control byte below 32 announces that many literals and one more. Any other one is a back reference: its upper three
// bits are the length less two (7: the next byte is added), its lower five and the next byte the distance less one.
#pragma once

#include <cstdint>

namespace geokit {

// Fills `out` from `packed`. Returns -1, or the first byte of `packed` that is damaged: a reference to before the
// beginning, a run beyond the end, or another size than that of `out`, whose bytes then mean nothing.
std::int64_t lzf_decompress(const std::uint8_t* packed, std::int64_t packed_size, std::uint8_t* out, std::int64_t size);

// Most bytes that lzf_compress writes for so many: each 32 literals cost one more, and the last run may be short.
constexpr std::int64_t lzf_bound(std::int64_t size) { return size + size / 32 + 2; }

// Writes `plain` as LZF to `out`, which has room for lzf_bound(size) bytes; returns how many it has used.
std::int64_t lzf_compress(const std::uint8_t* plain, std::int64_t size, std::uint8_t* out);

} // namespace geokit
