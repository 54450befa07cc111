"""Cohesive grains in a bowl that a ring stirs: a hash grid, a moving mesh and an SDF volume in the user's own kernels.

python examples/granular.py [--grains 5000] [--seconds 2] [--frames 60] [--device cuda:0] [--overlap 0.05] [--out bowl]

Soft spheres with springs and dashpots (Cundall and Strack 1979) that attract each other over a short range (Luding
2008, simplified) and do not spin. SI units. The kernels are in granular_kernels.py; docs/granular.md has the equations
and the step that is stable.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import warp as wp
from granular_charts import animate
from granular_kernels import MOST_NEAR, SKIN, World, list_kernel, step_kernel

import geokit as gk

RING = Path(__file__).resolve().parents[1] / "data" / "samples" / "torus.ply"
STEP_SHARE = 0.22  # the default step's share of a pair's critical one, 2 / omega; packings stand 0.267 and more


def grains(radius=5e-3, density=1500.0, stiffness=5000.0, restitution=0.5, friction=0.4, bond=4.0, gravity=9.81):
    """Material of grains: pairs rebound with the restitution, and attract with ``bond`` times their weight."""
    w, mass, loss = World(), density * 4.0 / 3.0 * np.pi * radius**3, -np.log(restitution)
    w.radius, w.mass, w.stiffness, w.friction, w.gravity = radius, mass, stiffness, friction, gravity
    w.damping, w.cohesion = np.sqrt(2.0 * stiffness * mass) * loss / np.hypot(np.pi, loss), bond * mass * 9.81
    w.range, w.turn = max(0.05 * radius, w.cohesion / stiffness), 0.0
    return w


def soft_grains(count, overlap=0.05):
    """Grains as soft as the given overlap allows at the bottom of such a bowl [radii]; softer grains allow longer
    steps."""
    w = grains()
    load = bowl_radius(count, w.radius) / (1.7 * w.radius) * w.mass * w.gravity + w.cohesion  # so many layers
    return grains(stiffness=load / (overlap * w.radius))


class Scene:
    """Grains at x with velocities v, between a volume that stands still and a surface that turns about z."""

    def __init__(self, x, world, *, v=0.0, volume=None, surface=None, turn=0.0, step=None, device=None):
        self.w, self.time, self.every, self.frames, self.volume, self.surface = world, 0.0, 16, {}, volume, surface
        self.step, self.device = step or STEP_SHARE * np.sqrt(2.0 * world.mass / world.stiffness), wp.get_device(device)
        self.team = gk.threads.Team(device=self.device)
        side, world.volume = int(1.5 * len(x) ** (1 / 3)) + 4, volume.id(self.device) if volume else 0
        if surface:
            world.mesh, world.origin, world.scale, world.turn = surface.id, surface.origin, surface.scale, turn
        with wp.ScopedDevice(self.device):
            self.xs, self.vs = (wp.array(np.zeros((2, *x.shape)) + a, dtype=wp.vec3) for a in (x, v))  # old and new
            self.x, self.v, self.last_x = self.xs[0], self.vs[0], wp.array(x, dtype=wp.vec3)
            self.grid, self.clear = wp.HashGrid(side, side, side), wp.zeros(len(x), dtype=wp.vec2)
            self.lists = wp.empty((MOST_NEAR, len(x)), dtype=int), wp.empty(len(x), dtype=int)
            self.angle, self.most = wp.zeros(1, dtype=float), wp.zeros((self.team.threads, 2), dtype=float)
        self.team.sequence(self._list(0))()

    def advance(self, steps):
        """Advance by an even number of steps; lists are renewed only when a grain has moved half of the skin."""
        before, moved, half = (wp.clone(self.x), wp.clone(self.v)), np.inf, 0.5 * SKIN * self.w.radius
        self.angle.fill_(self.w.turn * self.time % (2.0 * np.pi))
        while not moved <= half:
            self.most.zero_()
            frame = self.frames[steps, self.every] = self.frames.get((steps, self.every)) or self._frame(steps)
            frame()
            moved, near = self.most.numpy().max(axis=0)
            if near > MOST_NEAR or (self.every == 1 and not moved <= half):
                raise RuntimeError(f"unstable: a grain has {near:g} neighbors or moved {moved:g} m: shorten the step")
            if not moved <= half:  # neighbors may have been missed: once more, with twice as many lists
                self.every //= 2
                wp.copy(self.x, before[0])
                wp.copy(self.v, before[1])
                self.clear.zero_()
                self.team.sequence(self._list(0))()
        self.time += steps * self.step
        seldom = min(0.75 * half / max(moved, 1e-30), 2.0) * self.every
        self.every = max(1, min(int(seldom) // 2 * 2, steps))  # even: fewer graphs

    def _frame(self, steps):
        """Calls for so many steps: a launch between list renewals on a CPU, one graph on a GPU."""
        calls, most = [], 1 if self.device.is_cuda else self.every  # only a CPU's threads wait within a launch
        for k in range(0, steps, most):
            end = min(k + most, steps)
            given = k, end - k, self.xs, self.vs, self.w, self.angle, self.step, *self.lists, self.clear
            calls.append(self.team.record(step_kernel, len(self.x), given))
            calls += self._list(end % 2) if end % self.every == 0 or end == steps else []
        return self.team.sequence(calls)

    def _list(self, now):
        """Calls that renew the lists. A CPU reads 8 cells of twice the reach faster than 27 of the reach."""
        cell = (1.0 if self.device.is_cuda else 2.0) * ((2.0 + SKIN) * self.w.radius + self.w.range)
        given = now, self.grid.id, self.xs, self.w, self.last_x, *self.lists, self.most
        return [lambda: self.grid.build(self.xs[now], cell), self.team.record(list_kernel, len(self.x), given)]


def bowl_radius(count, radius):
    return 2.1 * radius * (1.7 * count / np.pi) ** (1 / 3)  # a lattice in the hemisphere has more than enough


def stirred_bowl(count, world, *, mesh=RING, turn=np.pi, step=None, device=None):
    """Grains on a lattice in a round bowl with the mesh upright among them, and the bowl's inner radius [m]."""
    r, size = world.radius, bowl_radius(count, world.radius)

    def far(p):
        return np.hypot(np.hypot(p[:, 0], p[:, 1]), np.minimum(p[:, 2], 0.0))

    box, ring = np.outer([-1, 1], [size + 6.0 * r] * 3), gk.mesh.load(mesh)
    bowl = gk.volume.from_function(lambda p: np.maximum(np.abs(far(p) - size - r) - r, p[:, 2] - size / 2.0), box, r)
    fitted = (ring.vertices - ring.bounds.mean(axis=0)) * (1.4 * size / np.ptp(ring.bounds, axis=0).max())
    surface = gk.mesh.Surface(gk.mesh.TriangleMesh(fitted[:, [0, 2, 1]] * (1, -1, 1), ring.faces), device=device)
    x = np.stack(np.meshgrid(*[np.arange(-size, size, 2.1 * r)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = x[far(x) < size - r] + np.random.default_rng(1).uniform(-0.04 * r, 0.04 * r, (np.sum(far(x) < size - r), 3))
    x = x[surface.signed_distance(x).distance > r]
    x = x[np.sort(np.argsort(x[:, 2], kind="stable")[:count])]
    return Scene(x, world, volume=bowl, surface=surface, turn=turn, step=step, device=device), size


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grains", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--frames", type=int, default=60, help="pictures in the animation; 0 draws nothing")
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--step", type=float, help="[s]; 0.22 of a pair's critical step if none")
    parser.add_argument("--overlap", type=float, default=0.05, help="of the lowest grains [radii]: sets the stiffness")
    parser.add_argument("--out", type=Path, default=Path("granular"), help="writes OUT.png and OUT.gif")
    args = parser.parse_args()
    scene, size = stirred_bowl(args.grains, soft_grains(args.grains, args.overlap), step=args.step, device=args.device)
    steps, r, states = 2 * int(np.ceil(1.0 / 120.0 / scene.step)), scene.w.radius, []
    scene.step, count, start = 1.0 / 60.0 / steps, round(60 * args.seconds), time.perf_counter()
    for _ in range(count):
        scene.advance(steps)
        states.append(scene.x.numpy().copy())
    print(f"{len(scene.x)} grains: {count / (time.perf_counter() - start):.1f} frames/s of {steps} steps")
    apart = gk.points.NeighborGrid(states[-1], 2.0 * r, device=scene.device).pairs().distance
    print(f"{2 * len(apart) / len(scene.x):.2f} contacts each, overlap <= {2 - apart.min(initial=2 * r) / r:.3f} radii")
    animate(scene, size, states, args.frames, args.out)


if __name__ == "__main__":
    main()
