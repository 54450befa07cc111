"""Derivatives of first hits with respect to the rays; the formulas are those of gradients.py."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def hit_slopes_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=int),
    directions: wp.array(dtype=Any),
    t: wp.array(dtype=Any),
    triangle_id: wp.array(dtype=int),
    by_t: wp.array(dtype=Any),
    out_origins: wp.array(dtype=Any),
    out_directions: wp.array(dtype=Any),
):
    """The slopes of origins and directions from those of t: a hit stays on the plane of its triangle.

    A miss has the slope 0. Either output may have no rows, where it is not wanted.
    """
    i = first + wp.tid()
    none = wp.float64(0.0)
    slope = wp.vec3d()
    far = none
    triangle = triangle_id[i]
    if triangle >= 0:
        a = vertices[faces[3 * triangle]]
        normal = wp.cross(vertices[faces[3 * triangle + 1]] - a, vertices[faces[3 * triangle + 2]] - a)
        steep = wp.dot(wp.vec3d(directions[i]), normal)
        if steep != none:
            slope = -((wp.float64(by_t[i]) / steep) * normal)
            far = wp.float64(t[i])
    if out_origins.shape[0] > 0:
        out_origins[i] = type(directions[i])(slope)
    if out_directions.shape[0] > 0:
        out_directions[i] = type(directions[i])(far * slope)


# By the type of the rays' coordinates.
HIT_SLOPES = {
    number: wp.overload(
        hit_slopes_kernel,
        {name: wp.array(dtype=vector) for name in ("directions", "out_origins", "out_directions")}
        | {name: wp.array(dtype=number) for name in ("t", "by_t")},
    )
    for number, vector in ((wp.float32, wp.vec3f), (wp.float64, wp.vec3d))
}
