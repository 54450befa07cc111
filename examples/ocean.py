"""A fleet on waves: Tessendorf's spectrum by an FFT, buoyancy and collisions in the user's own kernels.

python examples/ocean.py [--bodies 200] [--seconds 8] [--wind 5] [--every 6] [--device cuda:0] [--out ocean]

Bodies float by the water that they displace, bump into the level sets of each other and into the mesh of a harbor, and
find each other by a neighbor grid. SI units. The kernels are in ocean_kernels.py; docs/ocean.md has the model. Writes
OUT.gif, and OUT.png of the last frame.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import ocean_kernels as kernels
import warp as wp
from PIL import Image

import geokit as gk

SIDE, GRAVITY, STEPS = 64.0, 9.81, 4  # of the waves' square [m]; steps a frame of 1/60 s
STEP = 1.0 / 60.0 / STEPS
CELLS, SKIN = 250, 300  # that fill a body, and points on it
DEEP, CREST, STONE = np.array([[20.0, 80.0, 115.0], [150.0, 205.0, 215.0], [175.0, 170.0, 160.0]])
PALETTE = np.array(
    [[235, 85, 55], [245, 195, 60], [240, 240, 235], [120, 190, 95], [185, 110, 175], [250, 145, 45], [70, 75, 90]],
    float,
)


def kinds():
    """Shapes of the fleet, and their densities as shares of the water's."""
    bracket = gk.mesh.load(Path(__file__).resolve().parents[1] / "data" / "samples" / "bracket.obj")
    return [
        (gk.mesh.sphere(0.6, segments=32), 0.3),
        (gk.mesh.box((1.1, 1.1, 1.1)), 0.5),
        (gk.mesh.box((2.6, 1.2, 0.7)), 0.35),
        (gk.mesh.torus(0.8, 0.28), 0.35),
        (gk.mesh.cylinder(0.4, 1.3), 0.45),
        (gk.mesh.cone(0.7, 1.3), 0.4),
        (gk.mesh.transform(bracket, np.diag([0.05, 0.05, 0.05, 1.0])), 0.6),
    ]


def harbor(wide=38.0, thick=2.0, low=-5.0, high=1.6):
    """Four quays around the fleet, a breakwater, a pier, piles, and a lighthouse."""

    def wall(x, y, across, along):
        return gk.mesh.box((across, along, high - low), center=(x, y, 0.5 * (low + high)))

    far, edge = wide + 2.0 * thick, 0.5 * (wide + thick)
    piles = [gk.mesh.cylinder(0.4, high - low, center=(3.0 * k, 6.0, 0.5 * (low + high))) for k in range(1, 6)]
    tower = [
        gk.mesh.cylinder(0.9, 5.0, center=(edge, edge, high + 2.5)),
        gk.mesh.cone(1.3, 1.5, center=(edge, edge, high + 5.7)),
    ]
    quays = [
        wall(0, -edge, far, thick),
        wall(0, edge, far, thick),
        wall(-edge, 0, thick, wide),
        wall(edge, 0, thick, wide),
    ]
    return join([*quays, wall(-6.0, 0.25 * wide, thick, 0.5 * wide), wall(9.0, -6.0, 16.0, thick), *piles, *tower])[0]


def join(parts):
    """One mesh of all, and the part of each vertex."""
    starts = np.cumsum([0] + [part.vertex_count for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    mesh = gk.mesh.TriangleMesh(np.concatenate([part.vertices for part in parts]), faces)
    return mesh, np.repeat(np.arange(len(parts)), np.diff(starts))


class Waves:
    """Tessendorf's waves in a square that repeats; height and rate are one complex FFT of 2^n cells a side."""

    def __init__(self, team, wind=5.0, cells=512, seed=1):
        number = 2.0 * np.pi * np.fft.fftfreq(cells, SIDE / cells)
        x, y = np.meshgrid(number, number, indexing="ij")
        length = np.hypot(x, y)
        length[0, 0] = 1.0
        reach = max(wind, 1e-3) ** 2 / GRAVITY  # of the longest waves that the wind drives [m]
        along = (x + 0.4 * y) / np.hypot(1.0, 0.4) / length
        power = np.exp(-1.0 / (length * reach) ** 2 - (length * SIDE / cells) ** 2) / length**4 * along**2
        power[along < 0] *= 0.05  # few waves run against the wind
        power[0, 0] = power[cells // 2] = power[:, cells // 2] = 0.0
        random = np.random.default_rng(seed).normal(size=(2, cells, cells))
        toward = (random[0] + 1j * random[1]) * np.sqrt(power)
        against = np.conj(np.roll(toward[::-1, ::-1], (1, 1), (0, 1)))
        # Heights have a standard deviation of a quarter of Pierson and Moskowitz's significant height.
        tall = np.sqrt(np.sum(np.abs(toward) ** 2 + np.abs(against) ** 2))
        scale = 0.21 * wind**2 / GRAVITY / 4.0 / max(tall, 1e-30)
        table = scale * np.stack([against.real, against.imag, toward.real, toward.imag], axis=-1)
        roots = np.exp(2j * np.pi * np.arange(cells // 2) / cells)
        with wp.ScopedDevice(team.device):
            self.clock, self.given = wp.zeros(1, dtype=wp.float64), wp.array(table, dtype=wp.vec4)
            self.frequency = wp.array(np.sqrt(GRAVITY * length), dtype=float)
            roots = wp.array(np.stack([roots.real, roots.imag], axis=-1), dtype=wp.vec2)
            self.height, other = (wp.zeros((cells, cells), dtype=wp.vec2) for _ in range(2))
        calls = [team.record(kernels.spectrum_kernel, cells**2, [self.given, self.frequency, self.clock, self.height])]
        for axis in range(2):
            for k in range(cells.bit_length() - 1):
                arrays = [a.transpose() if axis else a for a in (self.height, other)]
                calls.append(team.record(kernels.butterfly_kernel, cells**2 // 2, [1 << k, roots, *arrays]))
                self.height, other = other, self.height
        self._move = team.sequence(calls)

    def move(self, seconds):
        """Make ``height`` that of a time."""
        self.clock.fill_(seconds)
        self._move()


class Ocean:
    """Bodies of some shapes at ``x``, in the water and beside a mesh that stands still."""

    def __init__(self, shapes, kind, x, *, wind=5.0, cells=512, solid=None, device=None):
        self.team, self.time, kind = gk.threads.Team(device=device), 0.0, np.asarray(kind)
        self.device, self.w, self.s, self.b = self.team.device, kernels.World(), kernels.Shapes(), kernels.Bodies()
        self.waves, self.kind, self.solid = Waves(self.team, wind, cells), kind, solid
        w, s, b, count = self.w, self.s, self.b, len(kind)
        w.gravity, w.water, w.drag, w.side, w.wave, w.margin = GRAVITY, 1000.0, 0.7, SIDE, self.waves.height, 0.1
        w.stiffness, w.damping, w.friction = 0.5 / STEP**2, 0.3 / STEP, 0.3  # soft against a step
        if solid:
            w.mesh, w.origin, w.scale = solid.id, solid.origin, solid.scale
        self.made = [Shape(mesh, density * w.water) for mesh, density in shapes]
        radius = np.array([made.radius for made in self.made])
        with wp.ScopedDevice(self.device):
            s.sdf = wp.array([made.sdf.id(self.device) for made in self.made], dtype=wp.uint64)
            s.voxel = wp.array([made.cell / 3.0 for made in self.made], dtype=float)
            s.cell = wp.array([made.edges for made in self.made], dtype=wp.vec3)
            s.radius = wp.array(radius, dtype=float)
            s.mass = wp.array([made.mass for made in self.made], dtype=float)
            s.inertia = wp.array([made.inertia for made in self.made], dtype=wp.mat33)
            s.fill = wp.array(np.concatenate([made.fill for made in self.made]), dtype=wp.vec4)
            s.thin = wp.array(np.concatenate([made.thin for made in self.made]), dtype=float)
            s.skin = wp.array(np.concatenate([made.skin for made in self.made]), dtype=wp.vec3)
            s.first_fill = wp.array(np.cumsum([0] + [len(made.fill) for made in self.made]), dtype=int)
            s.first_skin = wp.array(np.cumsum([0] + [len(made.skin) for made in self.made]), dtype=int)
            b.shape, b.x = wp.array(kind, dtype=int), wp.array(x, dtype=wp.vec3)
            b.v, b.spin, b.momentum = (wp.zeros(count, dtype=wp.vec3) for _ in range(3))
            b.turn = wp.array(np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), dtype=wp.quat)
            self.lanes = wp.zeros(count * kernels.LANES, dtype=wp.spatial_vector)
        # Whoever may touch within a frame: none moves by more than half a meter in it.
        self.grid = gk.points.NeighborGrid(b.x, 2.0 * radius.max() + 1.0, skin=1.0, device=self.device)

    def frame(self):
        """Advance by 1/60 s. Water rises evenly within a frame."""
        count = len(self.b.x)
        self.waves.move(self.time + 0.5 * STEPS * STEP)
        self.grid.update(self.b.x)
        near = self.grid.candidates(exclude_self=True)
        for step in range(STEPS):
            given = self.w, self.s, self.b, near.offsets, near.indices, (step + 1 - 0.5 * STEPS) * STEP, self.lanes
            self.team.run(kernels.force_kernel, count * kernels.LANES, given)
            self.team.run(kernels.move_kernel, count, [self.w, self.s, self.b, STEP, self.lanes])
        self.time += STEPS * STEP

    def posed(self, i):
        """The mesh of body i where it is."""
        pose = np.eye(4)
        pose[:3, :3] = np.array(wp.quat_to_matrix(wp.quat(*self.b.turn.numpy()[i].tolist()))).reshape(3, 3)
        pose[:3, 3] = self.b.x.numpy()[i]
        return gk.mesh.transform(self.made[self.kind[i]].mesh, pose)

    def draw(self, path, size, segments=128):
        sheet, height = gk.mesh.plane((SIDE, SIDE), segments=segments), self.waves.height.numpy()[..., 0]
        row, column, _ = np.floor(sheet.vertices.T * (len(height) / SIDE) + 0.5).astype(int) % len(height)
        z = height[row, column]
        water = gk.mesh.TriangleMesh(np.column_stack([sheet.vertices[:, :2], z]), sheet.faces)
        parts = [water] + [self.solid.mesh] * bool(self.solid) + [self.posed(i) for i in range(len(self.kind))]
        mesh, part = join(parts)
        color = np.concatenate([[DEEP] * (len(parts) - len(self.kind)), PALETTE[self.kind % len(PALETTE)]])[part]
        color[part == 1] = STONE
        color[: len(z)] += np.clip(0.4 + z / max(4.0 * z.std(), 1e-9), 0.0, 1.0)[:, None] * (CREST - DEEP)
        drawn = gk.mesh.TriangleMesh(mesh.vertices, mesh.faces, vertex_data={"color": color.astype(np.uint8)})
        gk.render.figure(path, mesh=drawn, size=size, up="z", azimuth=24, elevation=30, zoom=1.9)


class Shape:
    """A body of one density, its center of mass at 0: its level set, cells that fill it, and points on it."""

    def __init__(self, mesh, density):
        a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
        part = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        self.mesh = gk.mesh.TriangleMesh(mesh.vertices - part @ (a + b + c) / 4.0 / part.sum(), mesh.faces)
        self.mass, self.cell = density * mesh.volume, (mesh.volume / CELLS) ** (1 / 3)
        self.sdf = gk.volume.from_mesh(self.mesh, self.cell / 3.0, half_width=(3, 8))
        low, high = self.mesh.bounds
        counts = np.ceil((high - low) / self.cell).astype(int)  # the cells fill the bounding box exactly
        axes = [u + (np.arange(4 * n) + 0.5) / (4 * n) * (v - u) for u, v, n in zip(low, high, counts, strict=True)]
        parts = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        inside = self.sdf.sample(parts.reshape(-1, 3)) < 0.0
        parts = np.concatenate([parts, np.ones_like(parts[..., :1])], axis=-1) * inside.reshape(*parts.shape[:3], 1)
        cells = parts.reshape(counts[0], 4, counts[1], 4, counts[2], 4, 4).sum(axis=(1, 3, 5)).reshape(-1, 4)
        cells = cells[cells[:, 3] > 0.0]
        self.edges = (high - low) / counts
        self.thin = np.cbrt(cells[:, 3] / 64.0)
        self.fill = np.column_stack([cells[:, :3] / cells[:, 3:], cells[:, 3] * mesh.volume / cells[:, 3].sum()])
        self.skin = gk.mesh.sample_surface(self.mesh, SKIN, method="poisson_disk", seed=1).points
        self.radius = np.linalg.norm(self.mesh.vertices, axis=1).max()
        squares = density * (self.fill[:, :3].T * self.fill[:, 3]) @ self.fill[:, :3]
        squares += self.mass / 12.0 * np.diag(self.edges**2)
        self.inertia = np.trace(squares) * np.eye(3) - squares


def fleet(count, solid, seed=2):
    """Kinds and places of bodies, above the water and away from the harbor, in layers."""
    axis, random = np.arange(-17.4, 18.0, 2.9), np.random.default_rng(seed)
    x = np.stack(np.meshgrid(1.8 + 3.0 * np.arange(20), axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    x = x[solid.closest_point(x).distance > 1.8][:count]
    return random.integers(0, len(kinds()), len(x)), x + random.uniform(-0.1, 0.1, x.shape)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--wind", type=float, default=5.0, help="speed of the wind that made the waves [m/s]")
    parser.add_argument(
        "--every", type=int, default=6, help="frames of 1/60 s from picture to picture; 0 draws nothing"
    )
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--out", type=Path, default=Path("ocean"), help="writes OUT.png and OUT.gif")
    args = parser.parse_args()
    solid = gk.mesh.Surface(harbor(), device=args.device)
    kind, x = fleet(args.bodies, solid)
    ocean, pictures, spent = Ocean(kinds(), kind, x, wind=args.wind, solid=solid, device=args.device), [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(round(60 * args.seconds)):
            start = time.perf_counter()
            ocean.frame()
            wp.synchronize_device(ocean.device)
            spent.append(time.perf_counter() - start)
            if args.every and number % args.every == 0:
                ocean.draw(Path(folder) / "frame.png", (480, 300))
                with Image.open(Path(folder) / "frame.png") as picture:
                    pictures.append(picture.convert("RGB").quantize(64, dither=Image.Dither.NONE))
    if pictures:
        ocean.draw(args.out.with_suffix(".png"), (960, 600))
        pause = round(1000 / 60 * args.every)
        pictures[0].save(
            args.out.with_suffix(".gif"), save_all=True, append_images=pictures[1:], duration=pause, loop=0
        )
    print(f"{len(x)} bodies, {ocean.time:.1f} s: {1.0 / np.median(spent):.0f} frames/s on {ocean.device}")


if __name__ == "__main__":
    main()
