"""The trilinear interpolant of an adaptive field of floats, and its gradient, in the finest cell around each point.

stencil_kernels answers for fields of other orders and codecs.

A point's cell of level 0 is found as in any grid, and descent.inl goes down from there. Sums are those of
trilinear_table_kernels, in the same order: a field of one level equals a volume, and a CPU equals a GPU, to the last
bit. On a CPU a thread handles 64 queries at a time, as there.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp
from geokit.volume.adaptive.table_kernels import AdaptiveLevels
from geokit.volume.sampling.trilinear_table_kernels import ANSWERS, GROUP, overloads

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


for _point, _answer in ANSWERS:

    @cpp.func_native("volume/adaptive/sample_cpu.inl")
    def adaptive_group(
        levels: AdaptiveLevels, points: wp.array(dtype=_point), out: wp.array(dtype=_answer)
    ) -> wp.uint64:
        """Answers the points ``start`` to ``stop``, 64 at most; returns a bit mask of those beyond level 0."""
        ...


# Overloads: values or gradients, by the type of the last argument.
@cpp.func_native("volume/adaptive/sample.inl", function="adaptive_value")
def adaptive_single(levels: AdaptiveLevels, u: wp.vec3d, to_index: wp.mat33d, background: wp.float64) -> wp.float64:
    """The answer at index coordinates of level 0; NaN beyond the box of its table."""
    ...


@cpp.func_native("volume/adaptive/sample.inl", function="adaptive_slopes")
def adaptive_single(  # noqa: F811
    levels: AdaptiveLevels, u: wp.vec3d, to_index: wp.mat33d, background: wp.vec3d
) -> wp.vec3d: ...


# An item is a group of queries on a CPU, a single query on CUDA. Points beyond the box of level 0 get ``background``:
# the background of level 0 for values, and a zero vector for gradients. Non-finite points are among them and set
# out_nonfinite to 1.
@wp.kernel
def adaptive_cpu_kernel(
    first: int,
    levels: AdaptiveLevels,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_nonfinite: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, points.shape[0])
    left = adaptive_group(levels, start, stop, points, origin, to_index, out)
    if left != wp.uint64(0):
        for q in range(start, stop):
            if (left >> wp.uint64(q - start)) & wp.uint64(1) == wp.uint64(1):
                if not wp.isfinite(wp.vec3d(points[q])):
                    out_nonfinite[0] = 1
                out[q] = out.dtype(background)


@wp.kernel
def adaptive_cuda_kernel(
    first: int,
    levels: AdaptiveLevels,
    points: wp.array(dtype=Any),
    origin: wp.vec3d,
    to_index: wp.mat33d,
    background: Any,
    out: wp.array(dtype=Any),
    out_nonfinite: wp.array(dtype=int),
):
    i = first + wp.tid()
    point = wp.vec3d(points[i])
    u = to_index * (point - origin)
    found = adaptive_single(levels, u, to_index, background)
    if wp.isnan(found):
        if not wp.isfinite(point):
            out_nonfinite[0] = 1
        found = background
    out[i] = out.dtype(found)


SAMPLE_CPU = overloads(adaptive_cpu_kernel, wp.float64, wp.float32, wp.float64)
SAMPLE_CUDA = overloads(adaptive_cuda_kernel, wp.float64, wp.float32, wp.float64)
GRADIENT_CPU = overloads(adaptive_cpu_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
GRADIENT_CUDA = overloads(adaptive_cuda_kernel, wp.vec3d, wp.vec3f, wp.vec3d)
