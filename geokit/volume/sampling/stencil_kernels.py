"""Interpolants of order 2 and 3 and their derivatives: weighted sums over the 3^3 or 4^3 voxels around a point.

Every sum runs over differences from the voxel at the lower corner of the point's cell. Where all voxels are equal, the
value is exactly that value and derivatives are exactly 0, however the weights round. A large common value does not
cancel the digits of a small slope.

The stencil touches at most two nodes along each axis. Each is looked up once, as in read_voxel_kernels. Voxels are read
by rows along the last axis, so the branch on the grid type runs once per row.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.nanovdb.read_voxel_kernels import FLOAT_TYPE, grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

mat34d = wp.types.matrix(shape=(3, 4), dtype=wp.float64)
vec9d = wp.types.vector(length=9, dtype=wp.float64)


# The interpolant is chosen by type, so that the number of voxels is a constant of the kernels. As an argument it makes
# samples take several times as long.
@wp.struct
class Quadratic:
    """The triquadratic interpolant (order 2): parabolas through the voxels -1, 0 and 1 along each index axis."""

    order: int


@wp.struct
class Cubic:
    """The tricubic interpolant (order 3): Catmull-Rom splines through the voxels -1, 0, 1 and 2."""

    order: int


@wp.func
def voxels_of(basis: Quadratic) -> int:
    return 3


@wp.func
def voxels_of(basis: Cubic) -> int:  # noqa: F811
    return 4


@wp.func
def weights(basis: Quadratic, t: wp.float64) -> wp.mat44d:
    """Weights of the voxels at -1, 0 and 1 for a point at t in [0, 1), and their first two derivatives."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    half = wp.float64(0.5)
    none = wp.float64(0.0)
    return wp.mat44d(
        half * t * (t - one), one - t * t, half * t * (t + one), none,
        t - half, -two * t, t + half, none,
        one, -two, one, none,
        none, none, none, none,
    )  # fmt: skip


@wp.func
def weights(basis: Cubic, t: wp.float64) -> wp.mat44d:  # noqa: F811
    """Weights of the voxels at -1, 0, 1 and 2 for a point at t in [0, 1], and their first two derivatives."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    four = wp.float64(4.0)
    five = wp.float64(5.0)
    nine = wp.float64(9.0)
    half = wp.float64(0.5)
    none = wp.float64(0.0)
    return wp.mat44d(
        half * t * ((two - t) * t - one),
        half * (t * t * (three * t - five) + two),
        half * t * ((four - three * t) * t + one),
        half * t * t * (t - one),
        half * ((four - three * t) * t - one),
        half * t * (nine * t - wp.float64(10.0)),
        half * ((wp.float64(8.0) - nine * t) * t + one),
        half * t * (three * t - two),
        two - three * t,
        nine * t - five,
        four - nine * t,
        three * t - one,
        none, none, none, none,
    )  # fmt: skip


for _components, _center, _row in ((1, wp.float64, wp.vec4d), (3, wp.vec3d, mat34d), (4, wp.vec4d, wp.mat44d)):

    @cpp.func_native("volume/sampling/stencil_row.inl", defines={"COMPONENTS": str(_components)})
    def read_row(center: _center) -> _row:
        """Differences of up to four voxels along the last axis from ``center``; near and far are nodes from node_of."""
        ...


@wp.func
def along(row: wp.vec4d, weights: wp.vec4d):
    return wp.dot(row, weights)


@wp.func
def along(row: Any, weights: wp.vec4d):  # noqa: F811
    return row * weights


@wp.func
def slab_nodes(volume: wp.uint64, kind: int, x: int, j: int, k: int, cut_j: int, cut_k: int, count: int):
    """The four nodes of the stencil's voxels with first index x, below and above the leaf borders along j and k."""
    n00 = node_of(volume, kind, x, j, k)
    n01 = n00
    n10 = n00
    if cut_k < count:
        n01 = node_of(volume, kind, x, j, k + cut_k)
    n11 = n01
    if cut_j < count:
        n10 = node_of(volume, kind, x, j + cut_j, k)
        n11 = n10
        if cut_k < count:
            n11 = node_of(volume, kind, x, j + cut_j, k + cut_k)
    return n00, n01, n10, n11


@wp.func
def nodes_of_row(n00: wp.uint64, n01: wp.uint64, n10: wp.uint64, n11: wp.uint64, beyond: bool):
    """The two of a slab's four nodes that a row lies in; ``beyond`` says whether it is past the border along j."""
    if beyond:
        return n10, n11
    return n00, n01


@wp.func
def voxel_at(volume: wp.uint64, kind: int, i: int, j: int, k: int, family: Any):
    return read_voxel(volume, kind, node_of(volume, kind, i, j, k), i, j, k, family)


@wp.func
def voxels_to_border(first: int, count: int) -> int:
    """Number of the ``count`` voxels from ``first`` on that lie before the next leaf border."""
    return wp.min(count, 8 - (first & 7))


@wp.func
def placed(base: wp.vec3d, count: int):
    """The first voxel of a stencil, and how many of its voxels lie before the leaf borders along j and k."""
    j = int(base[1]) - 1
    k = int(base[2]) - 1
    return int(base[0]) - 1, j, k, voxels_to_border(j, count), voxels_to_border(k, count)


@wp.func
def value_by_rows(volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any):
    """stencil_value for grids of any type."""
    kind = grid_type_of(volume)
    count = voxels_of(basis)
    i, j, k, cut_j, cut_k = placed(base, count)
    center = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    total = zero
    z0 = z[0]
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, center)
            total += along(row, z0) * (x[0, a] * y[0, b])
    return center + total


@wp.func
def gradient_by_rows(
    volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any
):
    """stencil_gradient for grids of any type."""
    kind = grid_type_of(volume)
    count = voxels_of(basis)
    i, j, k, cut_j, cut_k = placed(base, count)
    center = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    along_i = zero
    along_j = zero
    along_k = zero
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, center)
            value = along(row, z[0])
            along_i += value * (x[1, a] * y[0, b])
            along_j += value * (x[0, a] * y[1, b])
            along_k += along(row, z[1]) * (x[0, a] * y[0, b])
    return along_i, along_j, along_k


@wp.func
def hessian_by_rows(volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d):
    """stencil_hessian for grids of any scalar type."""
    zero = wp.float64(0.0)
    kind = grid_type_of(volume)
    count = voxels_of(basis)
    i, j, k, cut_j, cut_k = placed(base, count)
    center = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    slope = wp.vec3d()
    straight = wp.vec3d()
    mixed = wp.vec3d()
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, center)
            r0 = along(row, z[0])
            r1 = along(row, z[1])
            r2 = along(row, z[2])
            weight = x[0, a] * y[0, b]
            slope += wp.vec3d(r0 * x[1, a] * y[0, b], r0 * x[0, a] * y[1, b], r1 * weight)
            straight += wp.vec3d(r0 * x[2, a] * y[0, b], r0 * x[0, a] * y[2, b], r2 * weight)
            # The pairs (j, k), (i, k), (i, j).
            mixed += wp.vec3d(r1 * x[0, a] * y[1, b], r1 * x[1, a] * y[0, b], r0 * x[1, a] * y[1, b])
    second = wp.mat33d(
        straight[0], mixed[2], mixed[1],
        mixed[2], straight[1], mixed[0],
        mixed[1], mixed[0], straight[2],
    )  # fmt: skip
    return slope, second


for _basis, _voxels in ((Quadratic, 3), (Cubic, 4)):

    @cpp.func_native("volume/sampling/stencil_float.inl", count=_voxels)
    def float_value(basis: _basis) -> wp.float64:
        """stencil_value for float grids; (i, j, k) is the first voxel of the stencil."""
        ...

    @cpp.func_native("volume/sampling/stencil_float.inl", count=_voxels)
    def float_gradient(basis: _basis) -> wp.vec3d:
        """stencil_gradient for float grids."""
        ...

    @cpp.func_native("volume/sampling/stencil_float.inl", count=_voxels)
    def float_hessian(basis: _basis) -> vec9d:
        """stencil_hessian for float grids: first, second, and mixed derivatives of the pairs (j, k), (i, k), (i, j)."""
        ...


@wp.func
def stencil_value(
    volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: wp.float64
):
    """Weighted sum of the stencil's voxels, which start one voxel before ``base`` along each axis.

    The weights of each axis are the first row of its matrix and add up to 1.
    """
    if grid_type_of(volume) == FLOAT_TYPE:
        return float_value(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, basis, x, y, z)
    return value_by_rows(volume, base, basis, x, y, z, zero)


@wp.func
def stencil_value(  # noqa: F811
    volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any
):
    return value_by_rows(volume, base, basis, x, y, z, zero)


@wp.func
def stencil_gradient(
    volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: wp.float64
):
    """Derivatives of stencil_value along each index axis. The second rows are the derivatives of the weights."""
    if grid_type_of(volume) == FLOAT_TYPE:
        d = float_gradient(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, basis, x, y, z)
        return d[0], d[1], d[2]
    return gradient_by_rows(volume, base, basis, x, y, z, zero)


@wp.func
def stencil_gradient(  # noqa: F811
    volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any
):
    return gradient_by_rows(volume, base, basis, x, y, z, zero)


@wp.func
def stencil_hessian(volume: wp.uint64, base: wp.vec3d, basis: Any, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d):
    """Gradient and Hessian of a scalar grid along the index axes.

    The third rows are the second derivatives of the weights.
    """
    if grid_type_of(volume) == FLOAT_TYPE:
        d = float_hessian(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, basis, x, y, z)
        return wp.vec3d(d[0], d[1], d[2]), wp.mat33d(d[3], d[8], d[7], d[8], d[4], d[6], d[7], d[6], d[5])
    return hessian_by_rows(volume, base, basis, x, y, z)
