// Coordinates of points in sorted order, an array for each axis.
//
// Expects points, order, begin, end, grid.

#if !defined(__CUDA_ARCH__)
// Processors with the microcode fix for gather instructions take ten times as long for one.
#pragma clang loop vectorize(disable)
for (int at = begin; at < end; ++at) {
    if (at + 16 < end)
        __builtin_prefetch(points.data + order.data[at + 16]);
    const auto& p = points.data[order.data[at]];
    grid.x.data[at] = p[0];
    grid.y.data[at] = p[1];
    grid.z.data[at] = p[2];
}
#endif
