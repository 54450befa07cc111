"""Boxes around shares of the points on a CPU: memory is read once, from front to back, as the vectors that it holds."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

# Points of a share: 24 KiB, so that the shares of all threads end together.
SHARE = wp.constant(1 << 10)

# Eight points in a row are three vectors of eight numbers, and number e of vector v is always of the same axis. What
# is not finite survives in a sum of differences; comparisons may pass over it.
BOX = """
#if !defined(__CUDA_ARCH__)
    typedef decltype(points.data[0][0] + points.data[0][0]) real;
    typedef real numbers __attribute__((ext_vector_type(8), aligned(4)));
    const real* const given = (const real*)(points.data) + 3 * (int64_t)(begin);
    const int count = 3 * (end - begin);
    numbers low[3], high[3], rest[3];
    for (int v = 0; v < 3; ++v) {
        for (int e = 0; e < 8; ++e)
            low[v][e] = given[(8 * v + e) % 3];
        high[v] = low[v];
        rest[v] = low[v] - low[v];
    }
    int at = 0;
    for (; at + 24 <= count; at += 24)
        for (int v = 0; v < 3; ++v) {
            const numbers p = *(const numbers*)(given + at + 8 * v);
            low[v] = p < low[v] ? p : low[v];
            high[v] = p > high[v] ? p : high[v];
            rest[v] += p - p;
        }
    for (; at < count; ++at) {
        const int v = at % 24 / 8, e = at % 8;
        const real p = given[at];
        low[v][e] = p < low[v][e] ? p : low[v][e];
        high[v][e] = p > high[v][e] ? p : high[v][e];
        rest[v][e] += p - p;
    }
    for (int axis = 0; axis < 3; ++axis) {
        double lower = low[0][axis], upper = high[0][axis], total = 0.0;
        for (int k = axis; k < 24; k += 3) {
            lower = low[k / 8][k % 8] < lower ? low[k / 8][k % 8] : lower;
            upper = high[k / 8][k % 8] > upper ? high[k / 8][k % 8] : upper;
            total += rest[k / 8][k % 8];
        }
        out_lower.data[share][axis] = lower + total;
        out_upper.data[share][axis] = upper + total;
    }
#endif
"""


@wp.func_native(BOX)
def box_of(
    points: wp.array(dtype=Any),
    begin: wp.int32,
    end: wp.int32,
    share: wp.int32,
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
): ...


@wp.kernel
def survey_host_kernel(
    first: int,
    points: wp.array(dtype=Any),
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Boxes around SHARE contiguous points each; one around a point that is not finite is not finite."""
    i = first + wp.tid()
    begin = i * SHARE
    box_of(points, begin, wp.min(begin + SHARE, points.shape[0]), i, out_lower, out_upper)


SURVEY_HOST = {r: wp.overload(survey_host_kernel, {"points": wp.array(dtype=r)}) for r in (wp.vec3d, wp.vec3f)}
