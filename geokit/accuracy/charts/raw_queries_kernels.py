"""Warp's own float32 queries, as user kernels would call them: the baseline for geokit's exact answers.

Warp's results are used as they are: without re-evaluation in float64, without padded boxes, and with any of equally
near triangles.
"""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False})

# Larger than any local distance: no limit.
FAR = wp.constant(1.0e30)


@wp.kernel
def raw_closest_point_kernel(
    first: int,
    mesh: wp.uint64,
    origin: wp.vec3d,
    scale: wp.float64,
    points: wp.array(dtype=wp.vec3d),
    out_points: wp.array(dtype=wp.vec3f),
    out_distance: wp.array(dtype=wp.float32),
    out_triangle_id: wp.array(dtype=int),
):
    i = first + wp.tid()
    local = wp.vec3f((points[i] - origin) / scale)
    query = wp.mesh_query_point_no_sign(mesh, local, FAR)
    if query.result:
        foot = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        out_points[i] = wp.vec3f(origin) + wp.float32(scale) * foot
        out_distance[i] = wp.float32(scale) * wp.length(foot - local)
        out_triangle_id[i] = query.face
    else:
        out_points[i] = wp.vec3f(wp.nan, wp.nan, wp.nan)
        out_distance[i] = wp.inf
        out_triangle_id[i] = -1


@wp.kernel
def raw_raycast_kernel(
    first: int,
    mesh: wp.uint64,
    origin: wp.vec3d,
    scale: wp.float64,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    out_t: wp.array(dtype=wp.float32),
    out_triangle_id: wp.array(dtype=int),
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, wp.vec3f((origins[i] - origin) / scale), wp.vec3f(directions[i]), FAR)
    if query.result:
        out_t[i] = wp.float32(scale) * query.t
        out_triangle_id[i] = query.face
    else:
        out_t[i] = wp.inf
        out_triangle_id[i] = -1


@wp.kernel
def raw_radius_count_kernel(
    first: int,
    grid: wp.uint64,
    points: wp.array(dtype=wp.vec3f),
    queries: wp.array(dtype=wp.vec3f),
    radius: float,
    out_count: wp.array(dtype=int),
):
    i = first + wp.tid()
    query = queries[i]
    count = int(0)
    for j in wp.hash_grid_query(grid, query, radius):
        if wp.length_sq(points[j] - query) <= radius * radius:
            count += 1
    out_count[i] = count
