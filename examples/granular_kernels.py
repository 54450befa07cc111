"""Kernels of granular.py: neighbor lists, and a step of all grains.

Everything is float32 and without atomic sums, so that runs are bit-identical, for any number of threads.
"""

import warp as wp

import geokit as gk

SKIN = 0.5  # grains so much farther off than they act are listed too [radii]: a list lasts for several steps
MOST_NEAR = 28  # room in a list: 18 equal spheres fit within its reach, a few more where they overlap
vectors, integers, floats = wp.array(dtype=wp.vec3), wp.array(dtype=wp.int32), wp.array(dtype=float)
vectors2, integers2, floats2 = wp.array2d(dtype=wp.vec3), wp.array2d(dtype=wp.int32), wp.array2d(dtype=float)
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class World:
    radius: float  # of a grain [m]
    mass: float  # [kg]
    stiffness: float  # of the spring [N/m]
    damping: float  # of the dashpots along and across the normal [N s/m]
    friction: float  # Coulomb's bound on the force across: a share of the spring's
    cohesion: float  # pull at contact [N], falling linearly to 0 over the range
    range: float  # [m]; at least cohesion / stiffness, or the pull were stiffer than the spring
    gravity: float  # along -z [m/s^2]
    volume: wp.uint64  # volume.id or 0
    mesh: wp.uint64  # surface.id or 0: its vertices are (body - origin) / scale, and the body turns about z
    origin: wp.vec3
    scale: float
    turn: float  # [rad/s]


@wp.func
def contact(gap: float, n: wp.vec3, v: wp.vec3, w: World):
    """Force on a grain [N] that moves with v relative to what it touches; n points from there to the grain."""
    spring, along = w.stiffness * wp.max(-gap, 0.0), wp.dot(v, n)
    pull = wp.min(w.cohesion / w.range * wp.max(w.range - gap, 0.0), w.cohesion)
    damping = wp.where(gap < 0.0, w.damping, 0.0)
    across, slide = wp.dot(v, v) - along * along, damping
    if damping * damping * across > w.friction * w.friction * spring * spring:  # a square: few contacts need the root
        slide = w.friction * spring / wp.sqrt(across)
    return (spring - pull - (damping - slide) * along) * n - slide * v


@wp.kernel
def list_kernel(share: gk.threads.Share, now: int, grid: wp.uint64, x: vectors2, w: World, last_x: vectors,
                near: integers2, count: integers, most: floats2):  # fmt: skip
    act, reach = 2.0 * w.radius + w.range, (2.0 + SKIN) * w.radius + w.range
    for k in range(wp.tid(), share.count, share.step):
        i = gk.threads.item(share, k)
        p, found, acting = x[now, i], wp.int32(0), wp.int32(0)
        for j in wp.hash_grid_query(grid, p, reach):
            square = wp.length_sq(x[now, j] - p)
            if j != i and square < reach * reach:
                at = wp.min(found, MOST_NEAR - 1)
                if square < act * act:  # those that act come first: a CPU foretells the steps' branches
                    near[at, i] = near[wp.min(acting, at), i]
                    at = wp.min(acting, at)
                    acting += 1
                near[at, i] = j
                found += 1
        count[i] = wp.min(found, MOST_NEAR)
        values = wp.vec2(wp.length(p - last_x[i]), float(found))
        for e in range(2):  # each thread of a CPU has a row: warp's atomics are none there
            if not (values[e] <= most[share.thread, e]):  # spares most of a GPU's the atomic, and lets NaN through
                wp.atomic_max(most, share.thread, e, wp.where(values[e] >= 0.0, values[e], 1.0e30))
        last_x[i] = p


@wp.func
def step_one(i: int, x: vectors, v: vectors, w: World, angle: float, dt: float, near: integers2, count: integers,
             clear: wp.array(dtype=wp.vec2), out_x: vectors, out_v: vectors):  # fmt: skip
    p, u, act = wp.vec3(x[i]), wp.vec3(v[i]), 2.0 * w.radius + w.range
    force = wp.vec3(0.0, 0.0, -w.gravity * w.mass)
    for k in range(count[i]):
        away = p - x[near[k, i]]
        if wp.length_sq(away) < act * act:
            distance = wp.length(away)
            force += contact(distance - 2.0 * w.radius, away / distance, u - v[near[k, i]], w)
    # How far it may go before it can reach volume or mesh, less twice what it has gone since, as x is rounded.
    free = 0.999999 * clear[i] - 2.0 * dt * wp.vec2(wp.length(u), wp.length(u) + wp.abs(w.turn) * wp.length(p))
    if w.volume != wp.uint64(0) and not free[0] > 0.0:
        slope, at = wp.vec3(), wp.volume_world_to_index(w.volume, p)
        gap = wp.volume_sample_grad_f(w.volume, at, wp.Volume.LINEAR, slope) - w.radius
        force += contact(gap, wp.normalize(slope), u, w)
        free[0] = (gap - w.range) / 1.7321  # distances that are linear between voxels climb by sqrt(3) at most
    if w.mesh != wp.uint64(0) and not free[1] > 0.0:  # it stays where it is: the grain is turned back
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle)
        local = (wp.quat_rotate_inv(turn, p) - w.origin) / w.scale
        found = wp.mesh_query_point_no_sign(w.mesh, local, act / w.scale)
        free[1] = w.radius
        if found.result:  # the grain's center never gets inside: no sign
            away = wp.quat_rotate(turn, local - wp.mesh_eval_position(w.mesh, found.face, found.u, found.v))
            gap = wp.length(away) * w.scale - w.radius
            moving = wp.cross(wp.vec3(0.0, 0.0, w.turn), p - away * w.scale)
            force += contact(gap, wp.normalize(away), u - moving, w)
            free[1] = gap - w.range
    clear[i] = free
    u += force * (dt / w.mass)  # symplectic Euler: the new velocity moves the grain
    out_v[i] = u
    out_x[i] = p + u * dt


@wp.kernel
def step_kernel(share: gk.threads.Share, first: int, steps: int, x: vectors2, v: vectors2, w: World, angle: floats,
                dt: float, near: integers2, count: integers, clear: wp.array(dtype=wp.vec2)):  # fmt: skip
    for s in range(first, first + steps):
        now, turned = s % 2, angle[0] + w.turn * float(s) * dt
        for k in range(wp.tid(), share.count, share.step):
            i = gk.threads.item(share, k)
            step_one(i, x[now], v[now], w, turned, dt, near, count, clear, x[1 - now], v[1 - now])
        gk.threads.barrier(share)
