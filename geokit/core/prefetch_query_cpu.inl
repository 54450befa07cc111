// Prefetches the query that comes AHEAD places after the one at this place of the order.
//
// Expects points, order, at, AHEAD.

#if !defined(__CUDA_ARCH__)
if (at + AHEAD < points.shape[0]) {
    const char* row = (const char*)(points.data + order.data[at + AHEAD]);
    __builtin_prefetch(row);
    __builtin_prefetch(row + sizeof(wp::vec3d) - 1);
}
#endif
