"""Signs of distances by winding numbers and by parity of rays; pseudonormals_kernels.py has the third method."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def missed_sign_kernel(
    first: int,
    winding: wp.array(dtype=wp.float64),
    triangle_id: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.float64),
):
    """Negate, in place, the distances of points that found no triangle and have a winding number above 1/2."""
    i = first + wp.tid()
    if triangle_id[i] < 0 and winding[i] > wp.float64(0.5):
        out_distance[i] = -out_distance[i]


@wp.kernel
def vote_kernel(first: int, crossings: wp.array(dtype=int), out_votes: wp.array(dtype=int)):
    """Add a vote for inside if a ray crosses the surface an odd number of times."""
    i = first + wp.tid()
    out_votes[i] = out_votes[i] + (crossings[i] & 1)


@wp.kernel
def parity_sign_kernel(first: int, votes: wp.array(dtype=int), needed: int, out_distance: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    if votes[i] >= needed:
        out_distance[i] = -out_distance[i]


@wp.kernel
def is_negative_kernel(first: int, distance: wp.array(dtype=wp.float64), out_inside: wp.array(dtype=wp.bool)):
    i = first + wp.tid()
    out_inside[i] = distance[i] < wp.float64(0.0)


@wp.kernel
def confidence_kernel(first: int, winding: wp.array(dtype=wp.float64), out_confidence: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    out_confidence[i] = wp.abs(winding[i] - wp.float64(0.5))


@wp.kernel
def missed_kernel(first: int, triangle_id: wp.array(dtype=int), out_any: wp.array(dtype=int)):
    i = first + wp.tid()
    if triangle_id[i] < 0:
        out_any[0] = 1


@wp.kernel
def take_sign_kernel(first: int, judged: wp.array(dtype=wp.float64), out_distance: wp.array(dtype=wp.float64)):
    """Negate, in place, the distances of points whose distance is negative in ``judged``."""
    i = first + wp.tid()
    if judged[i] < wp.float64(0.0):
        out_distance[i] = -out_distance[i]
