// Adds to a number atomically, on a GPU and across the threads of a CPU, and returns its old value.
//
// Expects values, the array; value, the amount; the macros NUMBER, its type, ATOMIC, a type of the same size that
// CUDA's atomicAdd takes, and AT, the element.
NUMBER* const place = values.data + (AT);
#if defined(__CUDA_ARCH__)
return (NUMBER)atomicAdd((ATOMIC*)place, (ATOMIC)value);
#else
return __atomic_fetch_add(place, value, __ATOMIC_RELAXED);
#endif
