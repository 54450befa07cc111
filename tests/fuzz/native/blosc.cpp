// Blosc frames as the reader of .nvdb files decompresses them: validated, into a buffer of the size that they state.
#include <blosc.h>

#include "exact.h"

// The library is not instrumented: its header's flags and how it ends stand for what was covered.
__attribute__((section("__libfuzzer_extra_counters"))) static uint8_t covered[256][4];

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size)
{
    constexpr size_t largest = 1 << 20;
    const Exact frame(data, size);
    size_t unpacked = 0;
    if (size < BLOSC_MIN_HEADER_LENGTH || blosc_cbuffer_validate(frame.data(), size, &unpacked) < 0) return 0;
    if (unpacked > largest) return 0;
    Exact out(unpacked);
    const int written = blosc_decompress_ctx(frame.data(), out.data(), unpacked, 1);
    if (written > int(unpacked)) std::abort();
    covered[frame.data()[2]][written <= 0 ? 0 : frame.data()[3] > 1 ? 1 : 2] = 1;
    return 0;
}
