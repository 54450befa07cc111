"""Closest point of a triangle to a query in float64, including slivers and triangles without area."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False})

# Squared sine of a corner's angle below which a triangle counts as a sliver. The region tests lose digits with the
# square of this sine: at 1e-4 the error is 1e-12 of an edge.
SLIVER_SINE_SQUARED = 1.0e-4


@cpp.func_native(
    "mesh/triangle/closest.inl", function="barycentric_of_closest", SLIVER_SINE_SQUARED=SLIVER_SINE_SQUARED
)
def closest_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Barycentric coordinates of the point of the triangle abc that is closest to p.

    Regions by the signs of edge functions (Ericson, Real-Time Collision Detection, 2005, 5.1.5). Differs: for a sliver
    the closest of its edges and its interior is used, so that a triangle without area acts as a segment or point.
    """
    ...


@wp.func
def offset_from_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, barycentric: wp.vec3d) -> wp.vec3d:
    """p minus the triangle's point, formed from differences so that a far-away frame costs no digits."""
    return (p - a) - barycentric[1] * (b - a) - barycentric[2] * (c - a)
