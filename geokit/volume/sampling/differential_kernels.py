"""Second-order central differences at the active voxels of leaves, in world space.

Each thread handles one voxel. Differences run along the index axes in float64. ``to_index`` is the inverse of the
transform's linear part: world derivative c is the sum over the axes a of ``difference[a] * to_index[a, c]``. This
holds for rotated, sheared and non-uniform voxels. Outputs of inactive voxels are not written.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.func
def is_set(masks: wp.array2d(dtype=wp.uint8), leaf: int, n: int) -> bool:
    return ((int(masks[leaf, n >> 3]) >> (n & 7)) & 1) != 0


@wp.func
def voxel_of(origin: wp.vec3i, n: int) -> wp.vec3i:
    return origin + wp.vec3i(n >> 6, (n >> 3) & 7, n & 7)


@wp.func
def value_at(volume: wp.uint64, kind: int, leaf: wp.uint64, origin: wp.vec3i, v: wp.vec3i, family: Any):
    """The value of a voxel. Voxels of the leaf at ``origin`` need no walk down the tree."""
    node = leaf
    if (v[0] & ~7) != origin[0] or (v[1] & ~7) != origin[1] or (v[2] & ~7) != origin[2]:
        node = node_of(volume, kind, v[0], v[1], v[2])
    return read_voxel(volume, kind, node, v[0], v[1], v[2], family)


@wp.func
def axis_step(axis: int) -> wp.vec3i:
    step = wp.vec3i(0, 0, 0)
    step[axis] = 1
    return step


@wp.func
def central(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, zero: Any):
    """Half the difference between the next and the previous voxel along an index axis."""
    kind = grid_type_of(volume)
    leaf = node_of(volume, kind, origin[0], origin[1], origin[2])
    step = axis_step(axis)
    above = value_at(volume, kind, leaf, origin, v + step, zero)
    below = value_at(volume, kind, leaf, origin, v - step, zero)
    return (above - below) * wp.float64(0.5)


@wp.func
def forward(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, zero: Any):
    """The next voxel along an index axis minus this one. In staggered grids: the far face minus the near face."""
    kind = grid_type_of(volume)
    leaf = node_of(volume, kind, origin[0], origin[1], origin[2])
    above = value_at(volume, kind, leaf, origin, v + axis_step(axis), zero)
    return above - value_at(volume, kind, leaf, origin, v, zero)


@wp.func
def row_of(matrix: wp.mat33d, row: int) -> wp.vec3d:
    return wp.vec3d(matrix[row, 0], matrix[row, 1], matrix[row, 2])


@wp.func
def gradient_term(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, row: wp.vec3d) -> wp.vec3d:
    return row * central(volume, origin, v, axis, wp.float64(0.0))


@wp.func
def divergence_term(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, row: wp.vec3d) -> wp.float64:
    return wp.dot(row, central(volume, origin, v, axis, wp.vec3d(wp.float64(0.0))))


@wp.func
def staggered_divergence_term(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, row: wp.vec3d) -> wp.float64:
    return wp.dot(row, forward(volume, origin, v, axis, wp.vec3d(wp.float64(0.0))))


@wp.func
def curl_term(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, axis: int, row: wp.vec3d) -> wp.vec3d:
    return wp.cross(row, central(volume, origin, v, axis, wp.vec3d(wp.float64(0.0))))


def _kernel_of(term: Any, kind: Any) -> Any:
    """The kernel that adds the terms of the three index axes, of type ``kind``."""

    @wp.kernel
    def derivative_kernel(
        first: int,
        volume: wp.uint64,
        origins: wp.array(dtype=wp.vec3i),
        masks: wp.array2d(dtype=wp.uint8),
        to_index: wp.mat33d,
        out: wp.array(dtype=kind),
    ):
        i = first + wp.tid()
        leaf = i >> 9
        if not is_set(masks, leaf, i & 511):
            return
        v = voxel_of(origins[leaf], i & 511)
        total = kind(wp.float64(0.0))
        for axis in range(3):
            total += term(volume, origins[leaf], v, axis, row_of(to_index, axis))
        out[i] = total

    return derivative_kernel


gradient_kernel = _kernel_of(gradient_term, wp.vec3d)
divergence_kernel = _kernel_of(divergence_term, wp.float64)
staggered_divergence_kernel = _kernel_of(staggered_divergence_term, wp.float64)
curl_kernel = _kernel_of(curl_term, wp.vec3d)


@wp.func
def second_difference(volume: wp.uint64, origin: wp.vec3i, v: wp.vec3i, a: int, b: int) -> wp.float64:
    """The second derivative along index axes a and b; mixed where they differ."""
    kind = grid_type_of(volume)
    leaf = node_of(volume, kind, origin[0], origin[1], origin[2])
    zero = wp.float64(0.0)
    p = axis_step(a)
    q = axis_step(b)
    if a == b:
        middle = value_at(volume, kind, leaf, origin, v, zero)
        above = value_at(volume, kind, leaf, origin, v + p, zero) - middle
        below = middle - value_at(volume, kind, leaf, origin, v - p, zero)
        return above - below
    above = value_at(volume, kind, leaf, origin, v + p + q, zero) - value_at(
        volume, kind, leaf, origin, v - p + q, zero
    )
    below = value_at(volume, kind, leaf, origin, v + p - q, zero) - value_at(
        volume, kind, leaf, origin, v - p - q, zero
    )
    return (above - below) * wp.float64(0.25)


@wp.kernel
def laplacian_kernel(
    first: int,
    volume: wp.uint64,
    origins: wp.array(dtype=wp.vec3i),
    masks: wp.array2d(dtype=wp.uint8),
    metric: wp.mat33d,
    out_laplacian: wp.array(dtype=wp.float64),
):
    """``metric`` is ``to_index @ to_index.T``. It is diagonal where the voxels' axes are orthogonal."""
    i = first + wp.tid()
    leaf = i >> 9
    if not is_set(masks, leaf, i & 511):
        return
    v = voxel_of(origins[leaf], i & 511)
    total = wp.float64(0.0)
    for a in range(3):
        for b in range(3):
            if metric[a, b] != wp.float64(0.0):
                total += metric[a, b] * second_difference(volume, origins[leaf], v, a, b)
    out_laplacian[i] = total
