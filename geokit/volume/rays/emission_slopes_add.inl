// Adds a share to the sum of its value as a whole number, in any order; hook ON_SHARE.
{
    const double by = LEAST.data[place];
    if (by > 0.0) {
        const long long amount = (long long)wp::floor(share * by * WHOLE + 0.5);
#if defined(__CUDA_ARCH__)
        atomicAdd((unsigned long long*)(SUMS.data + place), (unsigned long long)amount);
#else
        __atomic_fetch_add(SUMS.data + place, amount, __ATOMIC_RELAXED);
#endif
    }
}
