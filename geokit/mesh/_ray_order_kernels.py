"""Where rays enter the box of a mesh: what they are put in order by."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def entry_into_cube(start: wp.vec3d, direction: wp.vec3d) -> wp.float64:
    """Where a ray enters the cube [-1, 1]^3, 0 where it starts inside or misses."""
    t = wp.float64(0.0)
    one = wp.float64(1.0)
    for k in range(3):
        if wp.abs(start[k]) > one and direction[k] * start[k] < wp.float64(0.0):
            t = wp.max(t, (wp.abs(start[k]) - one) / wp.abs(direction[k]))
    return t


@wp.kernel
def entry_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    origin: wp.vec3d,
    scale: wp.float64,
    out_points: wp.array(dtype=wp.vec3d),
):
    """Local point where each ray enters the mesh's box: rays from one camera differ only there."""
    i = first + wp.tid()
    start = (origins[i] - origin) / scale
    direction = directions[i] / scale
    out_points[i] = start + entry_into_cube(start, direction) * direction
