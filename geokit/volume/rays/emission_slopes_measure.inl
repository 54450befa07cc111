// Lowers the reciprocal of the largest power of two in the shares of a value; hook ON_SHARE.
{
#if defined(__CUDA_ARCH__)
    const long long bits = __double_as_longlong(share);
#else
    const long long bits = __builtin_bit_cast(long long, share);
#endif
    // Of a share that is not finite this is negative, less than any other.
    const int64_t value = (2046ll << 52) - (bits & 2047ll << 52);
    const long long at = place;
    const auto& values = LEAST;
#define NUMBER int64_t
#define ATOMIC long long
#include "core/lower_to.inl"
#undef NUMBER
#undef ATOMIC
}
