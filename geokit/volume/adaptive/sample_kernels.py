"""The interpolant of an adaptive field, and its gradient, in the finest cell around each point.

A point's cell of level 0 is found as in any grid, and descent.inl goes down from there. For order 1 and floats, sums
are those of trilinear_table_kernels, in the same order: a field of one level equals a volume, and a CPU equals a GPU,
to the last bit. On a CPU a thread handles 64 queries at a time, as there. For other orders and codecs the level's grid
is read as any volume is, with the sums of sample_kernels and smooth_kernels.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.adaptive.table_kernels import AdaptiveLevels
from geokit.volume.nanovdb.read_voxel_kernels import read_cell
from geokit.volume.sampling.sample_kernels import has_voxels, trilinear, trilinear_slopes, world_gradient
from geokit.volume.sampling.stencil_kernels import Cubic, Quadratic, stencil_gradient, stencil_value, weights
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


@wp.struct
class Linear:
    """The trilinear interpolant (order 1)."""

    order: int


@cpp.func_native("volume/adaptive/descent.inl", function="find_finest")
def find_cell(levels: AdaptiveLevels, u: wp.vec3d) -> wp.vec4i:
    """Level, and first voxel, of the finest cell around index coordinates of level 0."""
    ...


@wp.func
def value_in(volume: wp.uint64, base: wp.vec3d, f: wp.vec3d, basis: Linear):
    """The interpolant at fractions f of the cell whose first voxel is ``base``."""
    a, b, c, d, e, g, h, i = read_cell(volume, int(base[0]), int(base[1]), int(base[2]), wp.float64(0.0))
    return trilinear(a, b, c, d, e, g, h, i, f)


@wp.func
def value_in(volume: wp.uint64, base: wp.vec3d, f: wp.vec3d, basis: Any):  # noqa: F811
    zero = wp.float64(0.0)
    return stencil_value(volume, base, basis, weights(basis, f[0]), weights(basis, f[1]), weights(basis, f[2]), zero)


@wp.func
def slopes_in(volume: wp.uint64, base: wp.vec3d, f: wp.vec3d, basis: Linear):
    """Derivatives of value_in along the index axes of the cell's level."""
    a, b, c, d, e, g, h, i = read_cell(volume, int(base[0]), int(base[1]), int(base[2]), wp.float64(0.0))
    di, dj, dk = trilinear_slopes(a, b, c, d, e, g, h, i, f)
    return di, dj, dk


@wp.func
def slopes_in(volume: wp.uint64, base: wp.vec3d, f: wp.vec3d, basis: Any):  # noqa: F811
    zero = wp.float64(0.0)
    return stencil_gradient(volume, base, basis, weights(basis, f[0]), weights(basis, f[1]), weights(basis, f[2]), zero)


@wp.func
def answer_of(
    levels: AdaptiveLevels,
    cell: wp.vec4i,
    f: wp.vec3d,
    scale: wp.float64,
    to_index: wp.mat33d,
    basis: Any,
    kind: wp.float64,
):
    base = wp.vec3d(wp.float64(cell[1]), wp.float64(cell[2]), wp.float64(cell[3]))
    return value_in(levels.volume[cell[0]], base, f, basis)


@wp.func
def answer_of(  # noqa: F811
    levels: AdaptiveLevels,
    cell: wp.vec4i,
    f: wp.vec3d,
    scale: wp.float64,
    to_index: wp.mat33d,
    basis: Any,
    kind: wp.vec3d,
):
    base = wp.vec3d(wp.float64(cell[1]), wp.float64(cell[2]), wp.float64(cell[3]))
    a, b, c = slopes_in(levels.volume[cell[0]], base, f, basis)
    # A finer level's voxels are smaller by a power of two; its slopes are scaled to the units of level 0.
    return scale * world_gradient(a, b, c, to_index)


def _kernels_of(basis: Any, name: str) -> tuple[Any, Any]:
    """Overloads of the kernel of an interpolant, for values and for gradients, by whether points are float32.

    Each interpolant has a module of its own, so that an unused one is not compiled.
    """
    module = wp.get_module(f"{__name__}.{name}")
    wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False}, module=module)

    # Points beyond int32 get ``outside``: the background of level 0 for values, and a zero vector for gradients.
    # Non-finite points are among them and set out_nonfinite to 1.
    @wp.kernel(module=module)
    def adaptive_stencil_kernel(
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
        if has_voxels(u):
            cell = find_cell(levels, u)
            scale = wp.float64(1 << cell[0])
            # Doubling and the difference are exact, as in the descent.
            f = scale * wp.vec3d(u[0] - wp.floor(u[0]), u[1] - wp.floor(u[1]), u[2] - wp.floor(u[2]))
            f = wp.vec3d(f[0] - wp.floor(f[0]), f[1] - wp.floor(f[1]), f[2] - wp.floor(f[2]))
            out[i] = out.dtype(answer_of(levels, cell, f, scale, to_index, basis(), background))
        else:
            if not wp.isfinite(point):
                out_nonfinite[0] = 1
            out[i] = out.dtype(background)

    return (
        overloads(adaptive_stencil_kernel, wp.float64, wp.float32, wp.float64),
        overloads(adaptive_stencil_kernel, wp.vec3d, wp.vec3f, wp.vec3d),
    )


# By order: overloads for values and for gradients.
STENCILS = {
    1: _kernels_of(Linear, "linear"),
    2: _kernels_of(Quadratic, "quadratic"),
    3: _kernels_of(Cubic, "cubic"),
}
