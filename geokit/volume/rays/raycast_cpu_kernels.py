"""First crossings along rays on a CPU, through crossing blocks: a thread casts a packet of rays (raycast_cpu.inl)."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core.cpp import cpp
from geokit.volume.rays.crossing_blocks_kernels import BLOCK_WORDS
from geokit.volume.rays.raycast_kernels import MOST_ITERATIONS, RESOLUTION, SHORTEST_DIRECTION, RayField

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Rays in a packet: 8 are 5% slower, 32 no faster.
PACKET = wp.constant(16)
# If a cubic's coefficients add up to less, no value or slope of it on [0, 1] overflows.
LARGEST_SUM = 1e300


def _first_crossings(is_float: int) -> str:
    return cpp(
        "core/simd.inl",
        "volume/rays/raycast_cpu.inl",
        defines={
            "FLOAT_GRID": str(is_float),
            "SIDE_BY_SIDE": "1",
            "ON_CELL": '"volume/rays/raycast_cell.inl"',
            "BLOCK_CELLS": '"volume/rays/block_cells_cpu.inl"',
        },
        G=int(PACKET),
        ROUNDS=MOST_ITERATIONS,
        RESOLUTION=RESOLUTION,
        LARGEST_SUM=LARGEST_SUM,
        SHORTEST_DIRECTION=float(SHORTEST_DIRECTION),
        BLOCK_WORDS=BLOCK_WORDS,
    )


# Overloads: float grids or all other types, by the type of ``below`` and ``above``.
@wp.func_native(_first_crossings(1))
def first_crossings(
    start: int,
    stop: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float32,
    above: wp.float32,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
) -> int:
    """Writes the hits of the rays ``start`` to ``stop``. Returns 1 and writes nothing if a ray is not usable."""
    ...


@wp.func_native(_first_crossings(0))
def first_crossings(  # noqa: F811
    start: int,
    stop: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
) -> int: ...


# An item is a packet of rays.
@wp.kernel
def raycast_packets_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: Any,
    above: Any,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * PACKET
    stop = wp.min(start + PACKET, origins.shape[0])
    bad = first_crossings(
        start,
        stop,
        origins,
        directions,
        field,
        t_min,
        max_distance,
        isovalue,
        below,
        above,
        out_t,
        out_points,
        out_normals,
    )
    if bad != 0:
        # The host then refuses the whole batch and names the first bad row.
        out_bad[0] = 1


# Keys: whether the grid holds floats.
RAYCAST_PACKETS = {
    True: wp.overload(raycast_packets_kernel, {"below": wp.float32, "above": wp.float32}),
    False: wp.overload(raycast_packets_kernel, {"below": wp.float64, "above": wp.float64}),
}
