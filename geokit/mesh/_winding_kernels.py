"""Generalised winding numbers by warp's tree of solid angles, and the signs that follow from them."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})

# A node is taken as one dipole when the query is farther away than this many of its radii. 2 agrees with exact sums
# on clean, holed and overlapping meshes; 0.5 is wrong for a quarter of near points, 4 costs 2.4 times as much.
ACCURACY = 2.0

# The solid angle multiplies three float32 lengths; farther than this many local units they lose all digits, and the
# winding number has long been zero to float32.
FAR = wp.constant(wp.float64(1.0e6))

_WINDING = f"return wp::mesh_query_winding_number(id, p, {ACCURACY}f);"


@wp.func_native(_WINDING)
def tree_winding_number(id: wp.uint64, p: wp.vec3) -> float: ...


@wp.func
def winding_number_at(mesh: wp.uint64, origin: wp.vec3d, scale: wp.float64, empty: wp.float64, p: wp.vec3d) -> float:
    """Winding number of the mesh around the world point p, before any reorientation.

    Outside the cube of half width ``empty`` local units it is zero exactly: 1 for a closed mesh, infinite for others.
    """
    local = (p - origin) / scale
    largest = wp.max(wp.max(wp.abs(local[0]), wp.abs(local[1])), wp.abs(local[2]))
    w = float(0.0)
    if largest <= empty:
        if largest > FAR:
            local = local * (FAR / largest)
        w = tree_winding_number(mesh, wp.vec3(local))
    return w


@wp.kernel
def winding_number_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    mesh: wp.uint64,
    origin: wp.vec3d,
    scale: wp.float64,
    empty: wp.float64,
    orientation: float,
    out_winding: wp.array(dtype=wp.float64),
):
    i = order[first + wp.tid()]
    out_winding[i] = wp.float64(orientation * winding_number_at(mesh, origin, scale, empty, points[i]))


@wp.kernel
def contains_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    mesh: wp.uint64,
    origin: wp.vec3d,
    scale: wp.float64,
    empty: wp.float64,
    orientation: float,
    out_inside: wp.array(dtype=wp.bool),
):
    i = order[first + wp.tid()]
    out_inside[i] = orientation * winding_number_at(mesh, origin, scale, empty, points[i]) > 0.5


@wp.kernel
def sign_kernel(
    first: int,
    order: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3d),
    mesh: wp.uint64,
    origin: wp.vec3d,
    scale: wp.float64,
    empty: wp.float64,
    orientation: float,
    out_distance: wp.array(dtype=wp.float64),
):
    """Turns the distance of inside points negative, in place."""
    i = order[first + wp.tid()]
    if orientation * winding_number_at(mesh, origin, scale, empty, points[i]) > 0.5:
        out_distance[i] = -out_distance[i]
