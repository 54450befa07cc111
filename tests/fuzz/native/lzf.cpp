// LZF: any bytes decompress or are refused, and what is compressed comes back.
#include "../../../geokit/native/core/lzf.h"

#include "exact.h"

#include <cstdlib>
#include <cstring>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size)
{
    if (size < 2) return 0;
    const int64_t unpacked = data[0] | data[1] << 8;
    const Exact packed(data + 2, size - 2);
    Exact out(size_t(unpacked) * 4);
    const int64_t at = geokit::lzf_decompress(packed.data(), int64_t(packed.size()), out.data(), int64_t(out.size()));
    if (at < -1 || at > int64_t(packed.size())) std::abort();
    if (data[1] & 3) return 0;  // the compressor's table makes it slow

    Exact shorter{size_t(geokit::lzf_bound(int64_t(packed.size())))};
    const int64_t length = geokit::lzf_compress(packed.data(), int64_t(packed.size()), shorter.data());
    const Exact stored(shorter.data(), size_t(length));
    Exact back(packed.size());
    if (geokit::lzf_decompress(stored.data(), length, back.data(), int64_t(back.size())) != -1) std::abort();
    if (std::memcmp(back.data(), packed.data(), packed.size()) != 0) std::abort();
    return 0;
}
