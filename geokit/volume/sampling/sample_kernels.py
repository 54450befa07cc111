"""Values and gradients of a sparse volume at world points, by the nearest voxel and the trilinear interpolant.

Index coordinates, weights and sums are float64. The voxel's integer coordinates are subtracted before weights are
formed, so accuracy does not depend on where a grid lies in index space.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_cell, read_voxel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Voxel coordinates are int32. The upper end is two less, because a cell reads one voxel further and rounding to the
# nearest voxel adds a half.
LOWEST_INDEX = wp.constant(wp.float64(-2147483647.0))
HIGHEST_INDEX = wp.constant(wp.float64(2147483645.0))


@wp.func
def has_voxels(u: wp.vec3d) -> bool:
    """Whether the cell around index coordinates has int32 corners; False for NaN."""
    return (
        u[0] >= LOWEST_INDEX
        and u[0] <= HIGHEST_INDEX
        and u[1] >= LOWEST_INDEX
        and u[1] <= HIGHEST_INDEX
        and u[2] >= LOWEST_INDEX
        and u[2] <= HIGHEST_INDEX
    )


@wp.func
def nearest_voxel(u: wp.vec3d) -> wp.vec3i:
    """The voxel with the nearest center; halves round up."""
    half = wp.float64(0.5)
    return wp.vec3i(int(wp.floor(u[0] + half)), int(wp.floor(u[1] + half)), int(wp.floor(u[2] + half)))


@wp.func
def mix(a: Any, b: Any, t: wp.float64):
    # This form returns exactly a where a == b, so constant regions have no rounding noise.
    return a + (b - a) * t


@wp.func
def trilinear(c000: Any, c001: Any, c010: Any, c011: Any, c100: Any, c101: Any, c110: Any, c111: Any, f: wp.vec3d):
    """The trilinear interpolant of a cell at fractions f, with the same sums as trilinear.inl."""
    low = mix(mix(c000, c001, f[2]), mix(c010, c011, f[2]), f[1])
    high = mix(mix(c100, c101, f[2]), mix(c110, c111, f[2]), f[1])
    return mix(low, high, f[0])


@wp.func
def trilinear_slopes(
    c000: Any, c001: Any, c010: Any, c011: Any, c100: Any, c101: Any, c110: Any, c111: Any, f: wp.vec3d
):
    """Derivatives of the trilinear interpolant along each index axis, with the same sums as trilinear.inl."""
    # Differences come before averages, so that a large common value does not cancel the digits of a small slope.
    return (
        mix(mix(c100 - c000, c101 - c001, f[2]), mix(c110 - c010, c111 - c011, f[2]), f[1]),
        mix(mix(c010 - c000, c011 - c001, f[2]), mix(c110 - c100, c111 - c101, f[2]), f[0]),
        mix(mix(c001 - c000, c011 - c010, f[1]), mix(c101 - c100, c111 - c110, f[1]), f[0]),
    )


@wp.func
def voxel_value(volume: wp.uint64, i: int, j: int, k: int, family: Any):
    kind = grid_type_of(volume)
    return read_voxel(volume, kind, node_of(volume, kind, i, j, k), i, j, k, family)


@wp.func
def nearest_value(volume: wp.uint64, u: wp.vec3d, background: Any):
    if not has_voxels(u):
        return background
    v = nearest_voxel(u)
    return voxel_value(volume, v[0], v[1], v[2], background)


@wp.func
def linear_value(volume: wp.uint64, u: wp.vec3d, background: Any):
    """The trilinear interpolant at index coordinates."""
    if not has_voxels(u):
        return background
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    c000, c001, c010, c011, c100, c101, c110, c111 = read_cell(
        volume, int(base[0]), int(base[1]), int(base[2]), background
    )
    return trilinear(c000, c001, c010, c011, c100, c101, c110, c111, f)


@wp.func
def central_differences(volume: wp.uint64, u: wp.vec3d, zero: Any):
    """Central differences at the nearest voxel along each index axis."""
    if not has_voxels(u):
        return zero, zero, zero
    v = nearest_voxel(u)
    i = v[0]
    j = v[1]
    k = v[2]
    half = wp.float64(0.5)
    return (
        (voxel_value(volume, i + 1, j, k, zero) - voxel_value(volume, i - 1, j, k, zero)) * half,
        (voxel_value(volume, i, j + 1, k, zero) - voxel_value(volume, i, j - 1, k, zero)) * half,
        (voxel_value(volume, i, j, k + 1, zero) - voxel_value(volume, i, j, k - 1, zero)) * half,
    )


@wp.func
def linear_differences(volume: wp.uint64, u: wp.vec3d, zero: Any):
    """Derivatives of the trilinear interpolant along each index axis. On a border, the upper cell counts."""
    if not has_voxels(u):
        return zero, zero, zero
    base = wp.vec3d(wp.floor(u[0]), wp.floor(u[1]), wp.floor(u[2]))
    f = u - base
    c000, c001, c010, c011, c100, c101, c110, c111 = read_cell(volume, int(base[0]), int(base[1]), int(base[2]), zero)
    a, b, c = trilinear_slopes(c000, c001, c010, c011, c100, c101, c110, c111, f)
    return a, b, c


@wp.func
def world_derivative(along_i: Any, along_j: Any, along_k: Any, to_index: wp.mat33d, axis: int):
    """One world derivative from those along the index axes, by a row of the transform's inverse transpose."""
    return along_i * to_index[0, axis] + along_j * to_index[1, axis] + along_k * to_index[2, axis]


@wp.func
def world_gradient(along_i: wp.float64, along_j: wp.float64, along_k: wp.float64, to_index: wp.mat33d) -> wp.vec3d:
    return wp.vec3d(
        world_derivative(along_i, along_j, along_k, to_index, 0),
        world_derivative(along_i, along_j, along_k, to_index, 1),
        world_derivative(along_i, along_j, along_k, to_index, 2),
    )


@wp.func
def store_column(table: wp.array3d(dtype=wp.float64), i: int, column: int, value: wp.float64):
    table[i, 0, column] = value


@wp.func
def store_column(table: wp.array3d(dtype=wp.float64), i: int, column: int, value: wp.vec3d):  # noqa: F811
    for row in range(3):
        table[i, row, column] = value[row]


@wp.func
def store_column(table: wp.array3d(dtype=wp.float64), i: int, column: int, value: wp.vec4d):  # noqa: F811
    for row in range(4):
        table[i, row, column] = value[row]


def kernels_of(value: Any, differences: Any, module: Any = None) -> tuple[Any, Any]:
    """Kernels of an interpolant, for values and for gradients.

    Args:
        value: The interpolant, a function of volume, index coordinates and background.
        differences: Its derivatives along the index axes, a function of volume, index coordinates and zero.
        module: Warp module of the kernels; None for that of this file.
    """

    @wp.kernel(module=module)
    def sample_kernel(
        first: int,
        volume: wp.uint64,
        points: wp.array(dtype=wp.vec3d),
        origin: wp.vec3d,
        to_index: wp.mat33d,
        background: Any,
        out_value: wp.array(dtype=Any),
    ):
        i = first + wp.tid()
        out_value[i] = value(volume, to_index * (points[i] - origin), background)

    @wp.kernel(module=module)
    def gradient_kernel(
        first: int,
        volume: wp.uint64,
        points: wp.array(dtype=wp.vec3d),
        origin: wp.vec3d,
        to_index: wp.mat33d,
        zero: Any,
        out_jacobian: wp.array3d(dtype=wp.float64),
    ):
        i = first + wp.tid()
        a, b, c = differences(volume, to_index * (points[i] - origin), zero)
        for axis in range(3):
            store_column(out_jacobian, i, axis, world_derivative(a, b, c, to_index, axis))

    return sample_kernel, gradient_kernel


# Components of a value, and its type.
FAMILIES = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}


def sample_overloads(kernel: Any) -> dict[int, Any]:
    """Overloads of a kernel, keyed by the components of a value."""
    return {
        count: wp.overload(kernel, {"background": family, "out_value": wp.array(dtype=family)})
        for count, family in FAMILIES.items()
    }


def gradient_overloads(kernel: Any) -> dict[int, Any]:
    """Overloads of a kernel, keyed by the components of a value."""
    return {count: wp.overload(kernel, {"zero": family}) for count, family in FAMILIES.items()}


sample_nearest_kernel, gradient_nearest_kernel = kernels_of(nearest_value, central_differences)
sample_linear_kernel, gradient_linear_kernel = kernels_of(linear_value, linear_differences)
SAMPLE_NEAREST, SAMPLE_LINEAR = sample_overloads(sample_nearest_kernel), sample_overloads(sample_linear_kernel)
GRADIENT_NEAREST, GRADIENT_LINEAR = (
    gradient_overloads(gradient_nearest_kernel),
    gradient_overloads(gradient_linear_kernel),
)
