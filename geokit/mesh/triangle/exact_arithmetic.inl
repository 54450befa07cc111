// Products, sums and differences in float64 that are never fused into one rounding, and fused, x * y + z rounded once:
// the proofs hold for rounded results only.
#pragma once

typedef wp::vec_t<3, wp::float64> point;
// For long functions that are seldom called: inlined a dozen times each, they take half a minute to compile.
#define OUT_OF_LINE __attribute__((noinline))
#if defined(__CUDA_ARCH__)
static constexpr auto product = [](double x, double y) { return __dmul_rn(x, y); };
static constexpr auto plus = [](double x, double y) { return __dadd_rn(x, y); };
static constexpr auto minus = [](double x, double y) { return __dsub_rn(x, y); };
static constexpr auto fused = [](double x, double y, double z) { return __fma_rn(x, y, z); };
#else
static constexpr auto product = [](double x, double y) {
    #pragma clang fp contract(off)
    return x * y;
};
static constexpr auto plus = [](double x, double y) {
    #pragma clang fp contract(off)
    return x + y;
};
static constexpr auto minus = [](double x, double y) {
    #pragma clang fp contract(off)
    return x - y;
};
static constexpr auto fused = [](double x, double y, double z) { return __builtin_fma(x, y, z); };
#endif
