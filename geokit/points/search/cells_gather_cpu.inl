// Gathers the coordinates of points in sorted order, one array for each axis.
//
// Expects points, order, begin, end, grid.

#if !defined(__CUDA_ARCH__)
// Scalar loads: on processors with the microcode mitigation for gather instructions, a gather takes ten times as long.
#pragma clang loop vectorize(disable)
for (int at = begin; at < end; ++at) {
    if (at + 16 < end) __builtin_prefetch(points.data + order.data[at + 16]);
    const auto& p = points.data[order.data[at]];
    grid.x.data[at] = p[0];
    grid.y.data[at] = p[1];
    grid.z.data[at] = p[2];
}
#endif
