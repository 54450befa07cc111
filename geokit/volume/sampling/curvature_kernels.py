"""Computes the curvatures of a level set from the gradient and the Hessian of its field."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def tangent_to(normal: wp.vec3d) -> wp.vec3d:
    """A unit vector perpendicular to a unit vector; the axis of the smallest component is crossed with it."""
    x = wp.abs(normal[0])
    y = wp.abs(normal[1])
    z = wp.abs(normal[2])
    axis = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    if x <= y and x <= z:
        axis = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    elif y <= z:
        axis = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    return wp.normalize(wp.cross(normal, axis))


@wp.kernel
def curvature_kernel(
    first: int,
    gradient: wp.array(dtype=wp.vec3d),
    hessian: wp.array(dtype=wp.mat33d),
    out_mean: wp.array(dtype=wp.float64),
    out_gaussian: wp.array(dtype=wp.float64),
    out_principal: wp.array2d(dtype=wp.float64),
):
    i = first + wp.tid()
    half = wp.float64(0.5)
    # Division by the largest component keeps squares from overflow and underflow.
    g = gradient[i]
    largest = wp.max(wp.abs(g[0]), wp.max(wp.abs(g[1]), wp.abs(g[2])))
    length = wp.length(g / largest) * largest
    normal = wp.normalize(g / largest)
    u = tangent_to(normal)
    v = wp.cross(normal, u)
    # Eigenvalues of the shape operator in the tangent plane avoid the cancellation in mean^2 - gaussian.
    h = hessian[i]
    a = wp.dot(u, h * u) / length
    b = wp.dot(u, h * v) / length
    c = wp.dot(v, h * v) / length
    mean = half * (a + c)
    gaussian = a * c - b * b
    spread = wp.length(wp.vec2d(half * (a - c), b))
    if not largest > wp.float64(0.0):
        mean = wp.float64(wp.nan)
        gaussian = wp.float64(wp.nan)
    out_mean[i] = mean
    out_gaussian[i] = gaussian
    out_principal[i, 0] = mean + spread
    out_principal[i, 1] = mean - spread
