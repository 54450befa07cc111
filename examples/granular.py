"""Cohesive grains in a bowl that a ring stirs: a hash grid, a moving mesh and an SDF volume in the user's own kernels.

python examples/granular.py [--grains 5000] [--seconds 2] [--frames 60] [--device cuda:0] [--step 1e-4] [--out granular]

Soft spheres with springs and dashpots (Cundall and Strack 1979) that attract each other over a short range (Luding
2008, simplified) and do not spin. SI units. docs/granular.md has the equations and the step that is stable.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import warp as wp
from granular_charts import animate

import geokit as gk

RING = Path(__file__).resolve().parents[1] / "data" / "samples" / "torus.ply"
STEP_SHARE = 0.2  # the default step's share of a pair's critical one, 2 / omega; packings stand 0.29 and more
SKIN = 0.4  # grains so much farther off than they act are listed too [radii]: a list lasts for several steps
MOST_NEAR = 24  # room in a list: 18 equal spheres fit within its reach, a few more where they overlap
vectors, integers = wp.array(dtype=wp.vec3), wp.array(dtype=wp.int32)
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
    spring = w.stiffness * wp.max(-gap, 0.0)
    force = (spring - w.cohesion * wp.clamp(1.0 - gap / w.range, 0.0, 1.0)) * n
    if gap < 0.0:
        across = v - wp.dot(v, n) * n
        slide = wp.min(w.damping, w.friction * spring / wp.max(wp.length(across), 1.0e-12))
        force -= w.damping * (v - across) + slide * across
    return force


@wp.kernel
def list_kernel(grid: wp.uint64, x: vectors, w: World, last_x: vectors, near: wp.array2d(dtype=int),
                count: integers, most: wp.array(dtype=float)):  # fmt: skip
    i = wp.tid()
    reach, found = (2.0 + SKIN) * w.radius + w.range, wp.int32(0)
    for j in wp.hash_grid_query(grid, x[i], reach):
        if j != i and wp.length(x[j] - x[i]) < reach:
            near[wp.min(found, MOST_NEAR - 1), i] = j
            found += 1
    count[i] = wp.min(found, MOST_NEAR)
    values = wp.vec2(wp.length(x[i] - last_x[i]), float(found))
    for k in range(2):
        if not (values[k] <= most[k]):  # spares most threads the atomic, and lets NaN through
            wp.atomic_max(most, k, wp.where(values[k] >= 0.0, values[k], 1.0e30))
    last_x[i] = x[i]


@wp.kernel
def step_kernel(x: vectors, v: vectors, w: World, angle: wp.array(dtype=float), since: float, dt: float,
                near: wp.array2d(dtype=int), count: integers, out_x: vectors, out_v: vectors):  # fmt: skip
    i = wp.tid()
    force = wp.vec3(0.0, 0.0, -w.gravity * w.mass)
    for k in range(count[i]):
        away = x[i] - x[near[k, i]]
        distance = wp.length(away)
        force += contact(distance - 2.0 * w.radius, away / distance, v[i] - v[near[k, i]], w)
    if w.volume != wp.uint64(0):
        slope, at = wp.vec3(), wp.volume_world_to_index(w.volume, x[i])
        gap = wp.volume_sample_grad_f(w.volume, at, wp.Volume.LINEAR, slope) - w.radius
        force += contact(gap, wp.normalize(slope), v[i], w)
    if w.mesh != wp.uint64(0):  # stays where it is: the grain is turned back. Its centre never gets inside: no sign
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle[0] + w.turn * since)
        p = (wp.quat_rotate_inv(turn, x[i]) - w.origin) / w.scale
        found = wp.mesh_query_point_no_sign(w.mesh, p, (w.radius + w.range) / w.scale)
        if found.result:
            away = wp.quat_rotate(turn, p - wp.mesh_eval_position(w.mesh, found.face, found.u, found.v))
            moving = wp.cross(wp.vec3(0.0, 0.0, w.turn), x[i] - away * w.scale)
            force += contact(wp.length(away) * w.scale - w.radius, wp.normalize(away), v[i] - moving, w)
    out_v[i] = v[i] + force * (dt / w.mass)  # symplectic Euler: the new velocity moves the grain
    out_x[i] = x[i] + out_v[i] * dt


def grains(radius=5e-3, density=1500.0, stiffness=5000.0, restitution=0.5, friction=0.4, bond=4.0, gravity=9.81):
    """A world of grains whose pairs rebound with the restitution; bond times their weight pulls them together."""
    w, mass, loss = World(), density * 4.0 / 3.0 * np.pi * radius**3, -np.log(restitution)
    w.radius, w.mass, w.stiffness, w.friction, w.gravity = radius, mass, stiffness, friction, gravity
    w.damping, w.cohesion = np.sqrt(2.0 * stiffness * mass) * loss / np.hypot(np.pi, loss), bond * mass * 9.81
    w.range, w.turn = max(0.05 * radius, w.cohesion / stiffness), 0.0
    return w


class Scene:
    """Grains at x with velocities v, between a volume that stands still and a surface that turns about z."""

    def __init__(self, x, world, *, v=0.0, volume=None, surface=None, turn=0.0, step=None, device=None):
        self.w, self.time, self.every, self.graphs, self.volume, self.surface = world, 0.0, 16, {}, volume, surface
        self.step, self.device = step or STEP_SHARE * np.sqrt(2.0 * world.mass / world.stiffness), wp.get_device(device)
        side, world.volume = int(1.5 * len(x) ** (1 / 3)) + 4, volume.id(self.device) if volume else 0
        if surface:
            world.mesh, world.origin, world.scale, world.turn = surface.id, surface.origin, surface.scale, turn
        with wp.ScopedDevice(self.device):
            self.x, self.v, self.last_x = (wp.array(np.zeros_like(x) + a, dtype=wp.vec3) for a in (x, v, x))
            self.new, self.angle = (wp.empty_like(self.x), wp.empty_like(self.x)), wp.zeros(1, dtype=float)
            self.lists = wp.empty((MOST_NEAR, len(x)), dtype=int), wp.empty(len(x), dtype=int)
            self.grid, self.most = wp.HashGrid(side, side, side), wp.zeros(2, dtype=float)
        self._list(self.x)

    def advance(self, steps):
        """Goes on by an even number of steps, the lists renewed as seldom as no grain has gone half of the skin."""
        before, moved, half = (wp.clone(self.x), wp.clone(self.v)), np.inf, 0.5 * SKIN * self.w.radius
        self.angle.fill_(self.w.turn * self.time % (2.0 * np.pi))
        while not moved <= half:
            self.most.zero_()
            if self.device.is_cuda and (steps, self.every) not in self.graphs:
                with wp.ScopedCapture(self.device) as self.graphs[steps, self.every]:
                    self._launch(steps)
            wp.capture_launch(self.graphs[steps, self.every].graph) if self.device.is_cuda else self._launch(steps)
            moved, near = self.most.numpy()
            if near > MOST_NEAR or (self.every == 1 and not moved <= half):
                raise RuntimeError(f"unstable: a grain has {near:g} neighbours or moved {moved:g} m: shorten the step")
            if not moved <= half:  # neighbours may have been missed: once more, with twice as many lists
                self.every //= 2
                wp.copy(self.x, before[0])
                wp.copy(self.v, before[1])
                self._list(self.x)
        self.time += steps * self.step
        self.every *= 2 if moved < half / 3.0 and self.every < steps else 1

    def _list(self, x):
        self.grid.build(x, (2.0 + SKIN) * self.w.radius + self.w.range)
        inputs = self.grid.id, x, self.w, self.last_x, *self.lists, self.most
        wp.launch(list_kernel, len(x), inputs, device=self.device)

    def _launch(self, steps):
        old, new = (self.x, self.v), self.new
        for k in range(steps):
            inputs = [*old, self.w, self.angle, k * self.step, self.step, *self.lists, *new]
            wp.launch(step_kernel, len(self.x), inputs, device=self.device)
            old, new = new, old
            if k % self.every == self.every - 1 or k == steps - 1:
                self._list(old[0])


def stirred_bowl(count, world, *, mesh=RING, turn=np.pi, step=None, device=None):
    """Grains on a lattice in a round bowl with the mesh upright among them, and the bowl's inner radius [m]."""
    r, size = world.radius, 2.1 * world.radius * (1.7 * count / np.pi) ** (1 / 3)  # more than a hemisphere of lattice

    def far(p):
        return np.hypot(np.hypot(p[:, 0], p[:, 1]), np.minimum(p[:, 2], 0.0))

    box, ring = np.outer([-1, 1], [size + 6.0 * r] * 3), gk.mesh.load(mesh)
    bowl = gk.volume.from_function(lambda p: np.maximum(np.abs(far(p) - size - r) - r, p[:, 2] - size / 2.0), box, r)
    fitted = (ring.vertices - ring.bounds.mean(axis=0)) * (1.4 * size / np.ptp(ring.bounds, axis=0).max())
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(fitted[:, [0, 2, 1]] * (1, -1, 1), ring.faces), device=device)
    x = np.stack(np.meshgrid(*[np.arange(-size, size, 2.1 * r)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = x[far(x) < size - r] + np.random.default_rng(1).uniform(-0.04 * r, 0.04 * r, (np.sum(far(x) < size - r), 3))
    x = x[surface.signed_distance(x).distance > r]
    x = x[np.argsort(x[:, 2], kind="stable")[:count]]
    return Scene(x, world, volume=bowl, surface=surface, turn=turn, step=step, device=device), size


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grains", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--frames", type=int, default=60, help="pictures in the animation; 0 draws nothing")
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--step", type=float, help="[s]; a fifth of a pair's critical step if none")
    parser.add_argument("--out", type=Path, default=Path("granular"), help="writes OUT.png and OUT.gif")
    given = parser.parse_args()
    scene, size = stirred_bowl(given.grains, grains(), step=given.step, device=given.device)
    steps, r, states = 2 * int(np.ceil(1.0 / 120.0 / scene.step)), scene.w.radius, []
    scene.step, count, start = 1.0 / 60.0 / steps, round(60 * given.seconds), time.perf_counter()
    for _ in range(count):
        scene.advance(steps)
        states.append(scene.x.numpy().copy())
    print(f"{len(scene.x)} grains: {count / (time.perf_counter() - start):.1f} frames/s of {steps} steps")
    apart = gk.points.NeighborGrid(states[-1], 2.0 * r, device=scene.device).pairs().distance
    print(f"{2 * len(apart) / len(scene.x):.2f} contacts each, overlap <= {2 - apart.min(initial=2 * r) / r:.3f} radii")
    animate(scene, size, states, given.frames, given.out)


if __name__ == "__main__":
    main()
