// Number of candidates of one list that are within the limit.
//
// Expects verlet_row.inl. Returns the number.

int inside = 0;
#if defined(__CUDA_ARCH__)
each([&](double, double) { ++inside; });
#else
each([&](unsigned mask, d8, d8) { inside += __builtin_popcount(mask); });
#endif
return inside;
