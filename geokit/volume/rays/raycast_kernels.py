"""Finds the first crossing of the trilinear interpolant with an isovalue along each ray.

In a cell the interpolant is a cubic along the ray; see crossing.inl.
"""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.volume.rays.crossing_blocks_kernels import BLOCK_WORDS, by_voxel

# Unfused operations give equal bits on every device. Loops that are not unrolled compile in a tenth of the time.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Registers per thread on a GPU; see docs/design/launches-and-memory.md.
REGISTERS = 96

# Directions shorter than this would lose digits as denormal numbers.
SHORTEST_DIRECTION = wp.constant(wp.float64(1e-150))
# Bisection alone needs 53 halvings to reach the last bit of a position in a cell; Newton's steps take about five.
MOST_ITERATIONS = 64
# Two units in the last place of a position in a cell.
RESOLUTION = 4.5e-16


@wp.struct
class RayField:
    """A grid prepared for ray kernels."""

    volume: wp.uint64
    # World to index, relative to the anchor voxel: to_index * (point - corner).
    corner: wp.vec3d
    to_index: wp.mat33d
    anchor: wp.vec3i
    # All is background outside this box; index space relative to the anchor.
    lower: wp.vec3d
    upper: wp.vec3d
    # Tables of blocks without crossings, see crossing_blocks_kernels; empty if they were not built.
    reach: wp.array(dtype=wp.int8)
    numbers: wp.array(dtype=int)
    first_block: wp.vec3i
    block_count: wp.vec3i
    blocks: wp.array(dtype=wp.uint64)


@wp.struct
class IndexRay:
    """A ray in index space relative to the anchor voxel; the largest component of ``toward`` is 1."""

    start: wp.vec3d
    toward: wp.vec3d
    t_first: wp.float64
    t_last: wp.float64
    # Factor from the t of the world.
    scale: wp.float64


NUMBERS = {"ROUNDS": MOST_ITERATIONS, "RESOLUTION": RESOLUTION, "BLOCK_WORDS": BLOCK_WORDS}


# Warp takes no Any where something is returned.
for _voxel in (wp.float32, wp.float64):

    @cpp.func_native("volume/rays/raycast.inl", **NUMBERS)
    def first_crossing(field: RayField, ray: IndexRay, isovalue: wp.float64, below: _voxel, above: _voxel) -> wp.vec4d:
        """Ray parameter of the first crossing, infinite for none, and the interpolant's gradient there in index space.

        ``below`` and ``above`` are the isovalue, or its neighbors in the voxel type if that type cannot represent it:
        float32 for grids of floats, float64 for all other types.
        """
        ...


@wp.func
def is_usable(origin: wp.vec3d, direction: wp.vec3d) -> bool:
    """Whether a ray is finite and its direction is not zero."""
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    none = (origin - origin) + (direction - direction)
    return largest >= SHORTEST_DIRECTION and none[0] + none[1] + none[2] == wp.float64(0.0)


@wp.func
def index_ray(
    field: RayField, origin: wp.vec3d, direction: wp.vec3d, t_min: wp.float64, max_distance: wp.float64
) -> IndexRay:
    """A ray of the world as the walks take it."""
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    unit = direction / largest
    toward = field.to_index * unit
    voxels = wp.max(wp.max(wp.abs(toward[0]), wp.abs(toward[1])), wp.abs(toward[2]))
    ray = IndexRay()
    ray.start = field.to_index * (origin - field.corner)
    ray.toward = toward / voxels
    ray.scale = voxels * largest
    ray.t_first = t_min * ray.scale
    ray.t_last = max_distance / wp.length(unit) * voxels
    return ray


@wp.func
def write_hit(
    i: int,
    found: wp.vec4d,
    scale: wp.float64,
    to_index: wp.mat33d,
    origin: wp.vec3d,
    direction: wp.vec3d,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
):
    if found[0] == wp.float64(wp.INF):
        none = wp.float64(wp.NAN)
        out_t[i] = found[0]
        out_points[i] = wp.vec3d(none, none, none)
        out_normals[i] = wp.vec3d(none, none, none)
        return
    t = found[0] / scale
    out_t[i] = t
    out_points[i] = origin + direction * t
    slope = wp.vec3d(found[1], found[2], found[3])
    out_normals[i] = wp.normalize(wp.transpose(to_index) * slope)


@wp.kernel(cuda_max_registers=REGISTERS)
def raycast_kernel(
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
    i = first + wp.tid()
    origin = origins[i]
    direction = directions[i]
    scale = wp.float64(1.0)
    found = wp.vec4d(wp.float64(wp.INF), scale, scale, scale)
    if is_usable(origin, direction):
        ray = index_ray(field, origin, direction, t_min, max_distance)
        found = first_crossing(field, ray, isovalue, below, above)
        scale = ray.scale
    else:
        # A miss, unless the host refuses the whole batch and names the first bad row.
        out_bad[0] = 1
    write_hit(i, found, scale, field.to_index, origin, direction, out_t, out_points, out_normals)


RAYCAST = by_voxel(raycast_kernel)
