"""Exact queries of a prepared surface, one by one, for the user's own kernels: :mod:`geokit.kernels`."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp
from geokit.core.interop.user_arrays_kernels import is_measurable
from geokit.mesh.bvh.nearest_kernels import nearest_slot
from geokit.mesh.bvh.ray_walk_kernels import ANY_HIT_CANDIDATES, CANDIDATES, PASS_CONSTANTS, WALK_CONSTANTS
from geokit.mesh.bvh.tree_kernels import SurfaceTree
from geokit.mesh.bvh.winding_kernels import WindingTree, is_inside, winding_number_at
from geokit.mesh.queries.closest_point_kernels import ClosestPoint, closest_in_slot
from geokit.mesh.queries.foot_slopes_kernels import SlopedFaces, corners_of, foot_slopes
from geokit.mesh.queries.hit_slopes_kernels import hit_slope
from geokit.mesh.sign.pseudonormals_kernels import Pseudonormals, is_behind

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# How signs are decided; without a sign a distance is NaN.
NO_SIGN, BY_PSEUDONORMALS, BY_WINDING = wp.constant(0), wp.constant(1), wp.constant(2)
INFINITE = wp.constant(wp.float64(wp.inf))
NAN = wp.constant(wp.float64(wp.nan))
ZERO = wp.constant(wp.float64(0.0))

# One ray at a time, in queues that are read in eights.
_RAYS = {**PASS_CONSTANTS, **WALK_CONSTANTS, "IN_FLIGHT": 8}


@wp.struct
class Surface:
    """A prepared surface in kernels, by :meth:`geokit.mesh.Surface.on_kernel`; its fields may change."""

    tree: SurfaceTree
    # For derivatives.
    faces: SlopedFaces
    sign: int
    # The faces that decide signs, where these are others than those of ``tree``.
    judge: SurfaceTree
    is_trimmed: bool
    pseudonormals: Pseudonormals
    # Distance from which on all points are outside [world].
    outside: wp.float64
    winding: WindingTree
    # Half width of the cube outside of which winding numbers are zero [local].
    empty: wp.float64


@wp.struct
class RayHit:
    """The first hit of a ray. A miss has triangle_id -1, an infinite t, and NaN elsewhere.

    Attributes:
        t: Where the ray hits, in units of its direction.
        triangle_id: The triangle that it hits.
        barycentric: Weights of the triangle's corners there.
    """

    t: wp.float64
    triangle_id: int
    barycentric: wp.vec3d


_FIRST = {"UNORDERED": False, "ANY_HIT": False, "CANDIDATES": CANDIDATES}
_ANY = {"UNORDERED": True, "ANY_HIT": True, "CANDIDATES": ANY_HIT_CANDIDATES}


@cpp.func_native("mesh/surfaces/user_rays.inl", SurfaceTree, **_RAYS, **_FIRST)
def cast_ray() -> wp.vec4d: ...


@cpp.func_native("mesh/surfaces/user_rays.inl", SurfaceTree, **_RAYS, **_ANY)
def test_ray() -> bool: ...


@wp.func
def closest_in_tree(tree: SurfaceTree, point: wp.vec3d, max_distance: wp.float64) -> ClosestPoint:
    slot = int(-1)
    if is_measurable(point) and max_distance >= ZERO:
        slot = nearest_slot(tree, point, max_distance * max_distance, -1)
    return closest_in_slot(tree, point, slot)


@wp.func
def closest_point(surface: Surface, point: wp.vec3d, max_distance: wp.float64 = INFINITE) -> ClosestPoint:
    """The closest point on a surface: the answer of :meth:`geokit.mesh.Surface.closest_point`.

    A point that is not finite is a miss. On a ``wp.Tape`` it has slopes by the point.

    Args:
        surface: ``surface.on_kernel()``.
        point: The query point [world].
        max_distance: Search radius [world]; within one that is negative or NaN there is nothing.
    """
    return closest_in_tree(surface.tree, point, max_distance)


@wp.func
def is_negative(surface: Surface, point: wp.vec3d, max_distance: wp.float64, found: ClosestPoint) -> bool:
    """Whether a point is inside, as signs are decided; ``found`` is its closest point."""
    if not is_measurable(point):
        return False
    if surface.sign == BY_WINDING:
        return is_inside(surface.judge, surface.winding, surface.empty, point)
    judged = found
    if surface.is_trimmed:
        judged = closest_in_tree(surface.judge, point, max_distance)
    if judged.triangle_id < 0:
        return winding_number_at(surface.judge, surface.winding, surface.empty, point) > wp.float64(0.5)
    if judged.distance >= surface.outside:
        return False
    return is_behind(surface.pseudonormals, point, judged.point, judged.triangle_id, judged.barycentric)


@wp.func
def signed_distance(surface: Surface, point: wp.vec3d, max_distance: wp.float64 = INFINITE) -> ClosestPoint:
    """The closest point with a distance that is negative inside: :meth:`geokit.mesh.Surface.signed_distance`.

    A point that is not finite is a miss outside. The distance is NaN on a surface that was prepared without signs. On a
    ``wp.Tape`` it has slopes by the point.

    Args:
        surface: ``surface.on_kernel(sign)``.
        point: The query point [world].
        max_distance: As for :func:`closest_point`; farther points have distance inf or -inf.
    """
    found = closest_in_tree(surface.tree, point, max_distance)
    if surface.sign == NO_SIGN:
        found.distance = NAN
    elif is_negative(surface, point, max_distance, found):
        found.distance = -found.distance
    return found


@wp.func
def slope_of_foot(
    surface: Surface, is_signed: bool, point: wp.vec3d, found: ClosestPoint, by: ClosestPoint
) -> wp.vec3d:
    """The slope of a point, from those of its answer; 0 for a miss."""
    slope = wp.vec3d()
    if found.triangle_id >= 0:
        mesh = surface.faces
        face = found.triangle_id
        on = corners_of(mesh, face)
        weights = found.barycentric
        d = found.distance
        slope, _ = foot_slopes(
            mesh, on, mesh.scale, is_signed, face, point, weights, d, by.distance, by.point, by.barycentric
        )
    return slope


@wp.func_grad(closest_point)
def adj_closest_point(surface: Surface, point: wp.vec3d, max_distance: wp.float64, adj_ret: ClosestPoint):
    found = closest_in_tree(surface.tree, point, max_distance)
    wp.adjoint[point] += slope_of_foot(surface, False, point, found, adj_ret)


@wp.func_grad(signed_distance)
def adj_signed_distance(surface: Surface, point: wp.vec3d, max_distance: wp.float64, adj_ret: ClosestPoint):
    found = signed_distance(surface, point, max_distance)
    wp.adjoint[point] += slope_of_foot(surface, True, point, found, adj_ret)


@wp.func
def raycast(
    surface: Surface,
    origin: wp.vec3d,
    direction: wp.vec3d,
    t_min: wp.float64 = ZERO,
    max_distance: wp.float64 = INFINITE,
) -> RayHit:
    """The first hit of a ray, watertight: the answer of :meth:`geokit.mesh.Surface.raycast`.

    A ray that is not finite, or has no direction, is a miss. On a ``wp.Tape`` it has slopes by origin and direction.

    Args:
        surface: ``surface.on_kernel()``.
        origin: Start of the ray [world].
        direction: Its direction, of any length [world].
        t_min: Hits with a smaller t are ignored, in units of the direction; nothing is hit where it is negative or NaN.
        max_distance: Length of the ray [world]; nothing is hit where it is negative or NaN.
    """
    found = cast_ray(surface.tree, origin, direction, t_min, max_distance)
    hit = RayHit()
    hit.t = found[0]
    hit.triangle_id = int(found[3])
    hit.barycentric = wp.vec3d(wp.float64(1.0) - found[1] - found[2], found[1], found[2])
    return hit


@wp.func_grad(raycast)
def adj_raycast(
    surface: Surface,
    origin: wp.vec3d,
    direction: wp.vec3d,
    t_min: wp.float64,
    max_distance: wp.float64,
    adj_ret: RayHit,
):
    hit = raycast(surface, origin, direction, t_min, max_distance)
    if hit.triangle_id >= 0:
        slope = hit_slope(corners_of(surface.faces, hit.triangle_id), direction, adj_ret.t, adj_ret.barycentric)
        wp.adjoint[origin] += slope
        wp.adjoint[direction] += hit.t * slope


@wp.func
def occluded(
    surface: Surface,
    origin: wp.vec3d,
    direction: wp.vec3d,
    t_min: wp.float64 = ZERO,
    max_distance: wp.float64 = INFINITE,
) -> bool:
    """Whether a ray hits anything: the answer of :meth:`geokit.mesh.Surface.occluded`, faster than :func:`raycast`.

    Args:
        surface, origin, direction, t_min, max_distance: As for :func:`raycast`.
    """
    return test_ray(surface.tree, origin, direction, t_min, max_distance)
