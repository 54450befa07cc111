"""Points in another order, or some of them."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    out_points[i] = points[index[i]]
