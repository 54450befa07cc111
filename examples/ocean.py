"""Floating bodies on waves: they are lifted by the water below a moving mesh and bump into each other and the basin.

python examples/ocean.py [--frames 72] [--device cpu] [--out ocean.gif]

The water is a mesh whose vertices move with the waves; a ray upwards from a point in a body tells how deep it is.
Bodies meet where points of one lie inside the level set of another. They are rigid; units are meters and tonnes.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"
GRAVITY, SIDE, DEPTH = 9.81, 8.0, 2.0
# Direction, length [m] and height [m] of the waves; deep water gives their speed.
WAVES = ((0.3, 5.0, 0.16), (1.2, 3.1, 0.09), (-0.5, 2.2, 0.05), (2.4, 1.4, 0.025))
STEP, STEPS_A_FRAME = 1.0 / 240.0, 10
# Contacts: spring and damping, per mass; soft against the step: 50 / 240 < 1 / 2. Drag of the water [1 / s].
STIFFNESS, DAMPING, DRAG = 50.0**2, 30.0, 2.5
UP = np.array([0.0, 0.0, 1.0])
PALETTE = np.array(
    [[40, 110, 160], [225, 90, 60], [240, 190, 60], [235, 235, 230], [120, 180, 90], [190, 110, 170]], np.uint8
)


class Body:
    """A rigid body of one density; ``fill`` are points of equal volume in it, ``skin`` points on its surface."""

    def __init__(self, mesh: gk.mesh.TriangleMesh, density: float, position: list[float], device: str | None) -> None:
        voxel = mesh.diagonal / 60.0
        axes = [np.arange(low, high, 3.0 * voxel) + 1.5 * voxel for low, high in mesh.bounds.T]
        cells = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        fill = cells[gk.mesh.Surface(mesh, device=device).contains(cells)]
        center = fill.mean(axis=0)
        self.mesh = gk.mesh.TriangleMesh(mesh.vertices - center, mesh.faces)
        self.fill, self.cell, self.mass = fill - center, mesh.volume / len(fill), density * mesh.volume
        self.skin = gk.mesh.sample_surface(self.mesh, 300, method="poisson_disk", seed=1).points
        self.surface = gk.mesh.Surface(self.mesh, device=device)
        self.sdf = gk.volume.from_mesh(self.surface, voxel, half_width=5.0)
        squares = self.fill.T @ self.fill * (self.mass / len(fill))
        self.inertia = np.eye(3) * (np.trace(squares) + 1e-9) - squares
        self.position, self.turn = np.array(position), np.eye(3)
        self.velocity, self.spin, self.force, self.torque = np.zeros((4, 3))

    def placed(self, points: np.ndarray) -> np.ndarray:
        return points @ self.turn.T + self.position

    def velocity_at(self, points: np.ndarray) -> np.ndarray:
        return self.velocity + np.cross(self.spin, points - self.position)

    def push(self, points: np.ndarray, forces: np.ndarray) -> None:
        self.force += forces.sum(axis=0)
        self.torque += np.cross(points - self.position, forces).sum(axis=0)

    def step(self) -> None:
        self.velocity += STEP * (self.force / self.mass - GRAVITY * UP)
        inertia = self.turn @ self.inertia @ self.turn.T
        self.spin += STEP * np.linalg.solve(inertia, self.torque - np.cross(self.spin, inertia @ self.spin))
        self.position += STEP * self.velocity
        angle = np.linalg.norm(self.spin) * STEP
        if angle > 0.0:  # Rodrigues' formula
            x, y, z = self.spin * STEP / angle
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            self.turn = (np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross) @ self.turn
            left, _, right = np.linalg.svd(self.turn)
            self.turn = left @ right
        self.force, self.torque = np.zeros(3), np.zeros(3)

    @property
    def pose(self) -> np.ndarray:
        return np.vstack([np.column_stack([self.turn, self.position]), [0, 0, 0, 1]])


class Ocean:
    """The waves in a square basin, and what floats on them."""

    def __init__(self, bodies: list[Body], waves=WAVES, device: str | None = None) -> None:
        self.bodies, self.waves, self.device, self.time = bodies, waves, device, 0.0
        self.sheet = gk.mesh.plane((SIDE, SIDE), segments=64)
        self.water = gk.mesh.Surface(self.sheet, device=device)
        self.basin = gk.volume.from_mesh(gk.mesh.box((SIDE, SIDE, 4 * DEPTH)), 0.1, half_width=6.0, device=device)

    def height(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height of the water at places, and how fast it rises."""
        height, rate = np.zeros(len(points)), np.zeros(len(points))
        for heading, length, tall in self.waves:
            number = 2.0 * np.pi / length
            speed = np.sqrt(GRAVITY * number)
            phase = number * (points[:, :2] @ [np.cos(heading), np.sin(heading)]) - speed * self.time
            height += tall * np.sin(phase)
            rate -= tall * speed * np.cos(phase)
        return height, rate

    def step(self) -> None:
        self.time += STEP
        moved = self.sheet.vertices.copy()
        moved[:, 2], _ = self.height(moved)
        self.water.update(moved)
        self.lift()
        for body in self.bodies:
            self.touch(body, None)
        for one, other in itertools.permutations(self.bodies, 2):
            if np.linalg.norm(one.position - other.position) < 0.5 * (one.mesh.diagonal + other.mesh.diagonal):
                self.touch(one, other)
        for body in self.bodies:
            body.step()

    def lift(self) -> None:
        """Buoyancy and drag, from how deep each point in a body is below the water's mesh."""
        for body in self.bodies:
            part, edge = body.placed(body.fill), body.cell ** (1 / 3)
            # From one cell below: a point just above the water is wet in part.
            depth = self.water.raycast(part - edge * UP, np.tile(UP, (len(part), 1))).t - edge
            wet = np.where(np.isfinite(depth), np.clip(depth / edge + 0.5, 0.0, 1.0), 0.0)[:, None]
            slip = body.velocity_at(part) - self.height(part)[1][:, None] * UP
            body.push(part, body.cell * wet * (GRAVITY * UP - DRAG * slip))

    def touch(self, one: Body, other: Body | None) -> None:
        """Push the points of one body out of another, or back into the basin."""
        points = one.placed(one.skin)
        turn, origin = (other.turn, other.position) if other else (np.eye(3), np.zeros(3))
        field, side = (other.sdf, 1.0) if other else (self.basin, -1.0)
        local = (points - origin) @ turn
        depth = -side * field.sample(local, device=self.device)
        if not (hit := depth > 0.0).any():
            return
        points, depth = points[hit], depth[hit, None]
        normals = side * field.gradient(local[hit], device=self.device) @ turn.T
        speed = one.velocity_at(points) - (other.velocity_at(points) if other else 0.0)
        inward = np.minimum((speed * normals).sum(axis=1, keepdims=True), 0.0)
        mass = 1.0 / (1.0 / one.mass + (1.0 / other.mass if other else 0.0))
        forces = mass / len(points) * (STIFFNESS * depth - DAMPING * inward) * normals
        one.push(points, forces)
        if other:
            other.push(points, -forces)

    def gap(self) -> float:
        """Least distance between two bodies; 0 where they touch."""
        pairs = itertools.combinations(self.bodies, 2)
        gaps = [a.surface.distance(b.surface, transform=np.linalg.inv(b.pose) @ a.pose).distance for a, b in pairs]
        return min(gaps, default=np.inf)

    def draw(self, path: Path) -> None:
        parts = [self.water.mesh, *(gk.mesh.transform(body.mesh, body.pose) for body in self.bodies)]
        starts = np.cumsum([0] + [part.vertex_count for part in parts])
        faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
        kinds = np.concatenate([np.full(part.vertex_count, number) for number, part in enumerate(parts)])
        colors = PALETTE[kinds % len(PALETTE)]
        scene = gk.mesh.TriangleMesh(
            np.concatenate([part.vertices for part in parts]), faces, vertex_data={"color": colors}
        )
        gk.render.figure(path, mesh=scene, size=(320, 200), up="z", azimuth=30, elevation=25, distance=13.0)


def fleet(device: str | None) -> list[Body]:
    bracket = gk.mesh.transform(gk.mesh.load(SAMPLES / "bracket.obj"), np.diag([0.04, 0.04, 0.04, 1.0]))
    return [
        Body(gk.mesh.sphere(0.6, segments=32), 0.4, [-1.5, 0.2, 0.8], device),
        Body(gk.mesh.box((1.6, 1.0, 0.7)), 0.45, [0.1, 0.0, 0.6], device),
        Body(gk.mesh.torus(0.8, 0.28), 0.35, [0.2, 0.3, 1.7], device),
        Body(gk.mesh.cylinder(0.45, 1.3), 0.6, [1.7, -0.6, 0.8], device),
        Body(bracket, 0.7, [-0.8, 1.6, 0.9], device),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=72)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--out", type=Path, default=Path("ocean.gif"), help="an animation, or a .png of four frames")
    arguments = parser.parse_args()
    from PIL import Image

    ocean, pictures = Ocean(fleet(arguments.device), device=arguments.device), []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.frames):
            for _ in range(STEPS_A_FRAME):
                ocean.step()
            ocean.draw(Path(folder) / f"{number}.png")
            pictures.append(Image.open(Path(folder) / f"{number}.png").convert("RGB"))
    if arguments.out.suffix == ".png":
        strip = Image.new("RGB", (640, 400))
        for i, k in enumerate(np.linspace(0, len(pictures) - 1, 4).round().astype(int)):
            strip.paste(pictures[k], (320 * (i % 2), 200 * (i // 2)))
        strip.save(arguments.out)
    else:
        pictures[0].save(arguments.out, save_all=True, append_images=pictures[1:], duration=42, loop=0)
    print(f"{arguments.out}: {len(pictures)} frames, {ocean.time:.2f} s; least gap between bodies {ocean.gap():.3f} m")


if __name__ == "__main__":
    main()
