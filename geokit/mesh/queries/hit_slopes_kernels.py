"""Derivatives of first hits by the rays and by the corners that they hit; the formulas are in gradients.py."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.mesh.queries.foot_slopes_kernels import (
    NONE,
    Corners,
    SlopedFaces,
    by_corners,
    corners_of,
    face_of,
    give,
    shared,
)

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def hit_slope(on: Corners, along: wp.vec3d, by_t: wp.float64, by_weights: wp.vec3d) -> wp.vec3d:
    """The slope of a ray's origin, from those of t and of the weights; 0 along the plane."""
    slope = wp.vec3d()
    normal = wp.cross(on.b - on.a, on.c - on.a)
    steep = wp.dot(along, normal)
    if steep != NONE:
        # Of the hit, within the plane.
        by_hit = wp.vec3d()
        if not (by_weights == wp.vec3d()):
            area = wp.dot(normal, normal)
            by_hit = ((by_weights[1] - by_weights[0]) / area) * wp.cross(on.c - on.a, normal)
            by_hit += ((by_weights[2] - by_weights[0]) / area) * wp.cross(normal, on.b - on.a)
        slope = by_hit - ((wp.dot(by_hit, along) + by_t) / steep) * normal
    return slope


@wp.kernel
def hit_slopes_kernel(
    first: int,
    mesh: SlopedFaces,
    owner: wp.array(dtype=int),
    directions: wp.array(dtype=Any),
    t: wp.array(dtype=Any),
    triangle_id: wp.array(dtype=int),
    barycentric: wp.array(dtype=Any),
    by_t: wp.array(dtype=Any),
    by_weights: wp.array(dtype=Any),
    out_origins: wp.array(dtype=Any),
    out_directions: wp.array(dtype=Any),
    out_corners: wp.array(dtype=Any),
    out_vertex: wp.array(dtype=int),
):
    """The slopes of rays and of the corners that they hit, from those of their hits, which stay on their planes.

    A miss has the slope 0. Slopes of answers that are 0, and outputs that are not wanted, have no rows.
    """
    i = first + wp.tid()
    slope = wp.vec3d()
    far = NONE
    slopes = Corners()
    face = triangle_id[i]
    if face >= 0:
        face = face_of(mesh, owner, i, face)
        slope_t = NONE
        slope_w = wp.vec3d()
        if by_t.shape[0] > 0:
            slope_t = wp.float64(by_t[i])
        if by_weights.shape[0] > 0:
            slope_w = wp.vec3d(by_weights[i])
        slope = hit_slope(corners_of(mesh, face), wp.vec3d(directions[i]), slope_t, slope_w)
        if not (slope == wp.vec3d()):
            far = wp.float64(t[i])
            slopes = shared(wp.vec3d(barycentric[i]), -slope)
    if out_origins.shape[0] > 0:
        out_origins[i] = type(directions[i])(slope)
    if out_directions.shape[0] > 0:
        out_directions[i] = type(directions[i])(far * slope)
    give(mesh, face, slopes, i, out_corners, out_vertex)


HIT_SLOPES = by_corners(
    hit_slopes_kernel,
    ("directions", "barycentric", "by_weights", "out_origins", "out_directions"),
    ("t", "by_t"),
)
