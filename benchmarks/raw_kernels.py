"""Raw warp kernels as users write them: the baseline of the benchmarks."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def raw_closest_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def raw_ray_kernel(
    mesh: wp.uint64, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
):
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e6)
    out[i] = wp.where(query.result, query.t, float(wp.inf))


@wp.kernel
def raw_any_hit_kernel(
    mesh: wp.uint64, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.bool)
):
    i = wp.tid()
    out[i] = wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], 1.0e6)


@wp.kernel
def raw_sample_kernel(volume: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, points[i]), wp.Volume.LINEAR)


@wp.func
def raw_count(grid: wp.uint64, points: wp.array(dtype=wp.vec3), radius: float, i: int) -> int:
    count = int(0)
    for j in wp.hash_grid_query(grid, points[i], radius):
        if wp.length_sq(points[j] - points[i]) <= radius * radius:
            count += 1
    return count


@wp.kernel
def raw_count_kernel(grid: wp.uint64, points: wp.array(dtype=wp.vec3), radius: float, out: wp.array(dtype=int)):
    i = wp.tid()
    out[i] = raw_count(grid, points, radius, i)


@wp.kernel
def raw_count_in_order_kernel(
    grid: wp.uint64, points: wp.array(dtype=wp.vec3), radius: float, out: wp.array(dtype=int)
):
    i = wp.hash_grid_point_id(grid, wp.tid())
    out[i] = raw_count(grid, points, radius, i)


@wp.kernel
def raw_closest_slice_kernel(first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = first + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def raw_signed_normal_slice_kernel(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
):
    i = first + wp.tid()
    query = wp.mesh_query_point_sign_normal(mesh, points[i], 1.0e6)
    out[i] = query.sign * wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def raw_signed_parity_slice_kernel(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
):
    i = first + wp.tid()
    query = wp.mesh_query_point(mesh, points[i], 1.0e6)
    out[i] = query.sign * wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def raw_signed_winding_slice_kernel(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
):
    i = first + wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e6, 2.0, 0.5)
    out[i] = query.sign * wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def raw_ray_slice_kernel(
    first: int,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=float),
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e6)
    out[i] = wp.where(query.result, query.t, float(wp.inf))


@wp.kernel
def raw_occluded_slice_kernel(
    first: int,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    out[i] = wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], 1.0e6)
