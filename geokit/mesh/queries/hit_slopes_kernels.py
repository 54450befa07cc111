"""Derivatives of first hits by the rays and by the corners that they hit; the formulas are in gradients.py."""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
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
        on = corners_of(mesh, face)
        along = wp.vec3d(directions[i])
        normal = wp.cross(on.b - on.a, on.c - on.a)
        steep = wp.dot(along, normal)
        if steep != NONE:
            # Of the hit, within the plane.
            by_hit = wp.vec3d()
            if by_weights.shape[0] > 0:
                slope_w = wp.vec3d(by_weights[i])
                area = wp.dot(normal, normal)
                by_hit = ((slope_w[1] - slope_w[0]) / area) * wp.cross(on.c - on.a, normal)
                by_hit += ((slope_w[2] - slope_w[0]) / area) * wp.cross(normal, on.b - on.a)
            total = wp.dot(by_hit, along)
            if by_t.shape[0] > 0:
                total += wp.float64(by_t[i])
            slope = by_hit - (total / steep) * normal
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
