"""Optical depth and emission along rays: integrals of the trilinear interpolant, cell by cell.

Along a ray the interpolant of a cell is a cubic, so its integral is a polynomial.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.rays.raycast_kernels import REGISTERS, IndexRay, RayField, index_ray, is_usable

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Largest optical depth of a step of the emission's quadrature. The integrand is a cubic times e^-x, where x is a
# quartic; six Gauss points are then off by 1e-12, and four were off by 1e-7 in rough fields.
STEP_DEPTH = 0.5
# The shortest step, as a share of a cell. Where the density needs a shorter one, no light leaves the cell anyway.
SHORTEST_STEP = 1e-12
# e^-x is zero in float64 beyond this.
OPAQUE = 746.0


NUMBERS = {"STEP_DEPTH": STEP_DEPTH, "SHORTEST_STEP": SHORTEST_STEP, "OPAQUE": OPAQUE}


# Warp takes no Any where something is returned.
for _family in (wp.float32, wp.float64):

    @cpp.func_native("volume/rays/emission.inl", **NUMBERS)
    def optical_depth(field: RayField, ray: IndexRay, family: _family) -> wp.float64:
        """Integral of the values along a ray, with lengths in units of its direction.

        The type of ``family`` is float32 for grids of floats, float64 for all other types.
        """
        ...


@cpp.func_native("volume/rays/emission.inl", **NUMBERS)
def depth_and_emission(field: RayField, emission_volume: wp.uint64, scale: wp.float64, ray: IndexRay) -> wp.vec2d:
    """Optical depth, ``scale`` times the integral of the values, and the integral of the attenuated emission."""
    ...


@wp.kernel(cuda_max_registers=REGISTERS)
def depth_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    family: Any,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_transmittance: wp.array(dtype=wp.float64),
    out_emission: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    if not is_usable(origins[i], directions[i]):
        # The host then refuses the whole batch and names the first bad row.
        out_bad[0] = 1
        return
    ray = index_ray(field, origins[i], directions[i], t_min, max_distance)
    depth = optical_depth(field, ray, family)
    out_transmittance[i] = wp.exp(-extinction * depth * (wp.length(directions[i]) / ray.scale))
    out_emission[i] = wp.float64(0.0)


# Keys: the type of ``family``, whose value is not read.
DEPTH = {kind: wp.overload(depth_kernel, {"family": kind}) for kind in (wp.float32, wp.float64)}


@wp.kernel
def emission_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    emission_volume: wp.uint64,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_transmittance: wp.array(dtype=wp.float64),
    out_emission: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    if not is_usable(origins[i], directions[i]):
        out_bad[0] = 1
        return
    ray = index_ray(field, origins[i], directions[i], t_min, max_distance)
    unit = wp.length(directions[i]) / ray.scale
    found = depth_and_emission(field, emission_volume, extinction * unit, ray)
    out_transmittance[i] = wp.exp(-found[0])
    out_emission[i] = found[1] * unit
