"""How transmittances and emissions change with the ray and with the values of both grids.

Each value's shares from all rays are added as whole numbers, in any order. Their unit is 2^-40 of the power of two
above the largest share, which a first walk finds.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.rays.integrate_kernels import NUMBERS
from geokit.volume.rays.raycast_kernels import IndexRay, RayField, index_ray

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Rays whose shares are added up together. A ray crosses the eight cells of a voxel once each; with 2^4 shares a ray, of
# at most 2^40 units each, sums stay below 2^62.
RAYS_AT_ONCE = 1 << 18
# Of a share divided by the largest power of two in its value's shares.
WHOLE = 2.0**39
# Reciprocal of the smallest such power, and its bits: shares below it count as 0 units or few.
LARGEST_RECIPROCAL_BITS = (1023 + 960) << 52


@cpp.func_native("volume/rays/integrate_slopes.inl", RayField, IndexRay, WHOLE=WHOLE, **NUMBERS)
def measure_slopes(): ...


@cpp.func_native("volume/rays/integrate_slopes.inl", RayField, IndexRay, WHOLE=WHOLE, **NUMBERS)
def add_slopes(): ...


@wp.kernel
def ray_slopes_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    slopes: wp.array(dtype=wp.vec3d),
    field: RayField,
    emission_volume: wp.uint64,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_origins: wp.array(dtype=wp.vec3d),
    out_directions: wp.array(dtype=wp.vec3d),
    out_length: wp.array(dtype=wp.vec2d),
    out_least: wp.array(dtype=wp.int64),
    out_least_light: wp.array(dtype=wp.int64),
):
    """Derivatives by the rays, and the least reciprocal of a power of two in the shares of each value.

    A row of ``slopes`` has the slope by the transmittance times the transmittance, the slope by the emission, and the
    emission.
    """
    i = first + wp.tid()
    ray = index_ray(field, origins[i], directions[i], t_min, max_distance)
    length = wp.length(directions[i])
    unit = length / ray.scale
    measure_slopes(
        i,
        field,
        emission_volume,
        extinction * unit,
        unit,
        slopes[i],
        ray,
        out_origins,
        out_directions,
        out_length,
        out_least,
        out_least_light,
    )
    to_world = wp.transpose(field.to_index)
    out_origins[i] = to_world * out_origins[i]
    # Integrals over t grow with the length of the direction, and a ray of limited length ends at its reach over that.
    along = out_length[i][0] + slopes[i][1] * slopes[i][2]
    if wp.isfinite(max_distance):
        along = along - out_length[i][1] * ray.scale * (max_distance / length)
    out_directions[i] = to_world * out_directions[i] / ray.scale + directions[i] * (along / (length * length))


@wp.kernel
def add_slopes_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    slopes: wp.array(dtype=wp.vec3d),
    field: RayField,
    emission_volume: wp.uint64,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    least: wp.array(dtype=wp.float64),
    least_light: wp.array(dtype=wp.float64),
    out_sums: wp.array(dtype=wp.int64),
    out_sums_light: wp.array(dtype=wp.int64),
):
    """Add the shares of each value of both grids, in units of 2^-39 over its ``least``."""
    i = first + wp.tid()
    ray = index_ray(field, origins[i], directions[i], t_min, max_distance)
    unit = wp.length(directions[i]) / ray.scale
    scale = extinction * unit
    row = slopes[i]
    add_slopes(field, emission_volume, scale, unit, row, ray, least, least_light, out_sums, out_sums_light)


@wp.kernel
def collect_kernel(
    first: int,
    places: wp.array(dtype=wp.int64),
    sums: wp.array(dtype=wp.int64),
    least: wp.array(dtype=wp.float64),
    out_total: wp.array(dtype=wp.float64),
):
    """Add the sums of the active values to their totals; NaN where a share was not finite."""
    i = first + wp.tid()
    place = places[i]
    share = wp.float64(sums[place]) / wp.float64(WHOLE) / least[place]
    if not least[place] > wp.float64(0.0):
        share = wp.float64(wp.NAN)
    out_total[i] = out_total[i] + share
