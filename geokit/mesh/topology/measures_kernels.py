"""Measures of single triangles, bit for bit those of the NumPy steps in mesh/topology/measures.py."""

# mypy: ignore-errors
import warp as wp

# Fused multiply-adds would round differently from NumPy.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def dot3(p: wp.vec3d, q: wp.vec3d) -> wp.float64:
    return (p[0] * q[0] + p[1] * q[1]) + p[2] * q[2]


@wp.func
def cross3(p: wp.vec3d, q: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


@wp.func
def local_point(p: wp.vec3d, middle: wp.vec3d, inverse_size: wp.float64) -> wp.vec3d:
    return wp.vec3d(
        (p[0] - middle[0]) * inverse_size, (p[1] - middle[1]) * inverse_size, (p[2] - middle[2]) * inverse_size
    )


@wp.kernel
def measure_kernel(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.int32),
    middle: wp.vec3d,
    inverse_size: wp.float64,
    out_twice_area: wp.array(dtype=wp.float64),
    out_six_volume: wp.array(dtype=wp.float64),
    out_longest_squared: wp.array(dtype=wp.float64),
    out_perimeter: wp.array(dtype=wp.float64),
):
    f = first + wp.tid()
    a = local_point(vertices[faces[3 * f]], middle, inverse_size)
    b = local_point(vertices[faces[3 * f + 1]], middle, inverse_size)
    c = local_point(vertices[faces[3 * f + 2]], middle, inverse_size)
    ab = b - a
    ac = c - a
    bc = c - b
    cross = cross3(ab, ac)
    square_ab = dot3(ab, ab)
    square_ac = dot3(ac, ac)
    square_bc = dot3(bc, bc)
    out_twice_area[f] = wp.sqrt(dot3(cross, cross))
    out_six_volume[f] = dot3(a, cross)
    out_longest_squared[f] = wp.max(wp.max(square_ab, square_ac), square_bc)
    out_perimeter[f] = (wp.sqrt(square_ab) + wp.sqrt(square_ac)) + wp.sqrt(square_bc)
