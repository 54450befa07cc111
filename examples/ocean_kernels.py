"""Kernels of ocean.py: waves by a spectrum and an FFT, forces on floating bodies, and their motion.

Lanes of a body share its points and add up on their own; one thread adds the lanes. So no sum is atomic, and runs are
bit-identical, for any number of threads. What body i does to j is what j feels from i, to the bit.
"""

import warp as wp

import geokit as gk

LANES = 16
UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))
floats, vectors, integers = wp.array(dtype=float), wp.array(dtype=wp.vec3), wp.array(dtype=int)
complexes = wp.array2d(dtype=wp.vec2)
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class World:
    gravity: float  # along -z [m/s^2]
    water: float  # its density [kg/m^3]
    drag: float  # of wet volume [1/s]
    stiffness: float  # of contacts, per mass [1/s^2]
    damping: float  # of contacts, per mass [1/s]
    friction: float  # Coulomb's bound: a share of the force along the normal
    side: float  # of the square in which the waves repeat [m]
    wave: complexes  # height of the water [m] and its rate [m/s]
    mesh: wp.uint64  # surface.id of what stands still, or 0: its vertices are (world - origin) / scale
    origin: wp.vec3
    scale: float
    margin: float  # what stands still is so much thicker [m]


@wp.struct
class Shapes:
    sdf: wp.array(dtype=wp.uint64)  # volume.id of each shape, whose center of mass is at 0
    voxel: floats  # [m]
    radius: floats  # of the ball around it [m]
    mass: floats  # [kg]
    inertia: wp.array(dtype=wp.mat33)  # [kg m^2]
    cell: vectors  # edges of the cells that fill it [m]
    fill: wp.array(dtype=wp.vec4)  # middle of a cell [m], volume of the shape in it [m^3]
    thin: floats  # how much thinner than a cell that part is
    first_fill: integers
    skin: vectors  # points on its surface
    first_skin: integers


@wp.struct
class Bodies:
    shape: integers
    x: vectors  # center of mass [m]
    v: vectors  # its velocity [m/s]
    turn: wp.array(dtype=wp.quat)
    spin: vectors  # angular velocity [rad/s]
    momentum: vectors  # angular momentum [kg m^2/s]


@wp.kernel
def spectrum_kernel(share: gk.threads.Share, amplitude: wp.array2d(dtype=wp.vec4), frequency: wp.array2d(dtype=float),
                    clock: wp.array(dtype=wp.float64), out: complexes):  # fmt: skip
    for k in range(wp.tid(), share.count, share.step):
        i = gk.threads.item(share, k)
        row, column = i // out.shape[1], i % out.shape[1]
        a, w = amplitude[row, column], frequency[row, column]
        angle = wp.float64(w) * clock[0]
        c, s = float(wp.cos(angle)), float(wp.sin(angle))
        # Waves that go along the wave vector and against it: h = (a e^iwt + b e^-iwt), packed as h + i dh/dt.
        along = wp.vec2(a[0] * c - a[1] * s, a[0] * s + a[1] * c)
        against = wp.vec2(a[2] * c + a[3] * s, a[3] * c - a[2] * s)
        out[row, column] = (1.0 - w) * along + (1.0 + w) * against


@wp.kernel
def butterfly_kernel(share: gk.threads.Share, span: int, roots: wp.array(dtype=wp.vec2), a: complexes, out: complexes):
    """One pass of Stockham's inverse FFT of radix 2 along the rows of ``a``; its span doubles from pass to pass."""
    half = a.shape[0] // 2
    for k in range(wp.tid(), share.count, share.step):
        i = gk.threads.item(share, k)
        row, column = i // a.shape[1], i % a.shape[1]
        block, low, high = row // span, a[row, column], a[row + half, column]
        root, less = roots[block * span], low - high
        out[row + block * span, column] = low + high
        out[row + (block + 1) * span, column] = wp.vec2(root[0] * less[0] - root[1] * less[1],
                                                        root[0] * less[1] + root[1] * less[0])  # fmt: skip


@wp.func
def water_at(w: World, p: wp.vec3):
    """Height of the water and its rate at x and y of ``p``, and the slopes of the height."""
    n = w.wave.shape[0]
    at = wp.vec2(p[0], p[1]) * (float(n) / w.side)
    fx, fy = at[0] - wp.floor(at[0]), at[1] - wp.floor(at[1])
    i, j = int(wp.floor(at[0])) % n, int(wp.floor(at[1])) % n
    i, j = (i + n) % n, (j + n) % n
    next_i, next_j = (i + 1) % n, (j + 1) % n
    a, b, c, d = w.wave[i, j], w.wave[next_i, j], w.wave[i, next_j], w.wave[next_i, next_j]
    low, high, left, right = wp.lerp(a, b, fx), wp.lerp(c, d, fx), wp.lerp(a, c, fy), wp.lerp(b, d, fy)
    middle = wp.lerp(low, high, fy)
    return wp.vec4(
        middle[0], middle[1], (right[0] - left[0]) * float(n) / w.side, (high[0] - low[0]) * float(n) / w.side
    )


@wp.func
def velocity_at(b: Bodies, i: int, p: wp.vec3):
    return b.v[i] + wp.cross(b.spin[i], p - b.x[i])


@wp.func
def contact(w: World, depth: float, n: wp.vec3, v: wp.vec3, mass: float):
    """Force [N] on a point that is so deep in a body and moves with v relative to it; n points out of the body."""
    along = wp.dot(v, n) / wp.length_sq(n)
    spring = wp.max(w.stiffness * depth - w.damping * along, 0.0)
    across = v - along * n
    return mass * (spring * n - wp.min(w.damping, w.friction * spring / (wp.length(across) + 1.0e-6)) * across)


@wp.func
def between(w: World, s: Shapes, b: Bodies, i: int, j: int, lane: int):
    """Force and torque about i's center from those points of body i of a lane that are inside of j, and the torque's
    opposite about j's."""
    force, torque, back = wp.vec3(), wp.vec3(), wp.vec3()
    one, other = b.shape[i], b.shape[j]
    sdf, first, end = s.sdf[other], s.first_skin[one], s.first_skin[one + 1]
    mass = 4.0 / float(end - first) / (1.0 / s.mass[one] + 1.0 / s.mass[other])
    for k in range(first + lane, end, LANES):
        p = b.x[i] + wp.quat_rotate(b.turn[i], s.skin[k])
        if wp.length(p - b.x[j]) < s.radius[other]:
            slope, local = wp.vec3(), wp.quat_rotate_inv(b.turn[j], p - b.x[j])
            depth = -wp.volume_sample_grad_f(sdf, wp.volume_world_to_index(sdf, local), wp.Volume.LINEAR, slope)
            if depth > 0.0 and wp.length_sq(slope) > 0.0:
                normal = wp.quat_rotate(b.turn[j], slope / s.voxel[other])
                f = contact(w, depth, normal, velocity_at(b, i, p) - velocity_at(b, j, p), mass)
                force, torque, back = force + f, torque + wp.cross(p - b.x[i], f), back - wp.cross(p - b.x[j], f)
    return force, torque, back


@wp.kernel
def force_kernel(share: gk.threads.Share, w: World, s: Shapes, b: Bodies, offset: wp.array(dtype=wp.int64),
                 near: integers, ahead: float, out: wp.array(dtype=wp.spatial_vector)):  # fmt: skip
    for k in range(wp.tid(), share.count, share.step):
        item = gk.threads.item(share, k)
        i, lane, force, torque = item // LANES, item % LANES, wp.vec3(), wp.vec3()
        x, turn, kind = b.x[i], b.turn[i], b.shape[i]
        edge = wp.dot(wp.abs(wp.quat_rotate_inv(turn, UP)), s.cell[kind])
        for c in range(s.first_fill[kind] + lane, s.first_fill[kind + 1], LANES):
            cell = s.fill[c]
            p = x + wp.quat_rotate(turn, wp.vec3(cell[0], cell[1], cell[2]))
            water = water_at(w, p)
            wet = wp.clamp((water[0] + ahead * water[1] - p[2]) / (edge * s.thin[c]) + 0.5, 0.0, 1.0)
            if wet > 0.0:  # pressure pushes along the normal of the water's surface
                lift = w.gravity * wp.vec3(-water[2], -water[3], 1.0)
                f = w.water * cell[3] * wet * (lift - w.drag * (velocity_at(b, i, p) - water[1] * UP))
                force, torque = force + f, torque + wp.cross(p - x, f)
        for n in range(int(offset[i]), int(offset[i + 1])):
            j = near[n]
            if wp.length(b.x[j] - x) < s.radius[kind] + s.radius[b.shape[j]]:
                f, mine, _ = between(w, s, b, i, j, lane)
                against, _, back = between(w, s, b, j, i, lane)
                force, torque = force + f - against, torque + mine + back
        local = (x - w.origin) / w.scale
        if (
            w.mesh != wp.uint64(0)
            and wp.mesh_query_point_no_sign(w.mesh, local, (s.radius[kind] + w.margin) / w.scale).result
        ):
            first, end = s.first_skin[kind], s.first_skin[kind + 1]
            for m in range(first + lane, end, LANES):
                p = x + wp.quat_rotate(turn, s.skin[m])
                local = (p - w.origin) / w.scale
                foot = wp.mesh_query_point_no_sign(w.mesh, local, w.margin / w.scale)
                if foot.result:
                    away = w.scale * (local - wp.mesh_eval_position(w.mesh, foot.face, foot.u, foot.v))
                    mass = 4.0 / float(end - first) * s.mass[kind]
                    f = contact(w, w.margin - wp.length(away), wp.normalize(away), velocity_at(b, i, p), mass)
                    force, torque = force + f, torque + wp.cross(p - x, f)
        out[item] = wp.spatial_vector(force, torque)


@wp.kernel
def move_kernel(share: gk.threads.Share, w: World, s: Shapes, b: Bodies, dt: float,
                lanes: wp.array(dtype=wp.spatial_vector)):  # fmt: skip
    for k in range(wp.tid(), share.count, share.step):
        i = gk.threads.item(share, k)
        push, kind = wp.spatial_vector(), b.shape[i]
        for lane in range(LANES):
            push += lanes[i * LANES + lane]
        b.v[i] = b.v[i] + dt * (wp.spatial_top(push) / s.mass[kind] - w.gravity * UP)
        b.x[i] = b.x[i] + dt * b.v[i]
        b.momentum[i] = b.momentum[i] + dt * wp.spatial_bottom(push)
        turn = wp.quat_to_matrix(b.turn[i])
        spin = turn * (wp.inverse(s.inertia[kind]) * (wp.transpose(turn) * b.momentum[i]))
        angle = wp.length(spin)
        if angle > 0.0:
            b.turn[i] = wp.normalize(wp.quat_from_axis_angle(spin / angle, angle * dt) * b.turn[i])
        b.spin[i] = spin
