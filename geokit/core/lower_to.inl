// Lowers an integer to the minimum of itself and `value`, also while other threads do.
//
// Expects values, at, value; NUMBER is the type of the integer, ATOMIC that by which CUDA's atomicMin knows it.

// Looked at first: most values are not lower, and threads that only read do not wait for each other.
NUMBER* const place = values.data + at;
NUMBER seen = *(volatile NUMBER*)place;
#if defined(__CUDA_ARCH__)
if (value < seen) atomicMin((ATOMIC*)place, (ATOMIC)value);
#else
while (value < seen && !__atomic_compare_exchange_n(place, &seen, value, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
#endif
