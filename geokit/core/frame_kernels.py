"""Boxes around points, and points in the local frame of a surface."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def boxes_kernel(
    first: int,
    span: int,
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    out_lower: wp.array(dtype=wp.vec3d),
    out_upper: wp.array(dtype=wp.vec3d),
):
    """Box around every span-th of the given boxes (or points, as both corners), from the item's own on."""
    item = first + wp.tid()
    low, high = wp.vec3d(lower[item]), wp.vec3d(upper[item])
    for i in range(item + span, lower.shape[0], span):
        low = wp.min(low, lower[i])
        high = wp.max(high, upper[i])
    out_lower[item] = low
    out_upper[item] = high


@wp.kernel
def local_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    lower: wp.vec3d,
    upper: wp.vec3d,
    origin: wp.vec3d,
    scale: wp.float64,
    out_local: wp.array(dtype=wp.vec3f),
):
    """Local coordinates of points, of which those outside the box are moved to its border."""
    i = first + wp.tid()
    point = wp.min(wp.max(points[i], lower), upper)
    out_local[i] = wp.vec3f((point - origin) / scale)
