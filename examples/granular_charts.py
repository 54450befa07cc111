"""Pictures of granular.py's scene: frames, an animation, and the effect of the step size.

python examples/granular_charts.py [OUT.png]   (the chart of docs/granular.md; about a minute on a CPU)

Energies are computed in float64 by geokit's own queries, independently of the simulation's kernels.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import geokit as gk

# Voxels on the inner radius of the bowl that is drawn: no edge shows steps in the still, and frames are small.
FRAME_VOXELS, STILL_VOXELS = 60, 120
# Pixels of a frame of the animation and of the still.
FRAME_SIZE, STILL_SIZE = (480, 400), (900, 750)
# Share of the picture's height that the bowl's outer diameter takes, as geokit.render aims: pixels of a grain follow.
BOWL_SHARE = 0.66
# Normal of the plane that cuts the bowl open: towards the viewer.
CUT = np.array([0.48, -0.88, 0.0])
# Grains of the chart, and its steps as shares of a pair's critical one.
CHART_GRAINS = 200
SHARES = np.concatenate([np.arange(0.05, 0.3, 0.05), np.arange(0.3, 0.455, 0.01), np.arange(0.5, 0.95, 0.1)])


def animate(scene: Any, size: float, states: list[np.ndarray], frames: int, out: Path) -> None:
    """OUT.png of the last state and OUT.gif of so many of all; nothing for 0 frames.

    Args:
        scene: The scene that went through the states, one every 1/60 s.
        size: Inner radius of its bowl [m].
        states: Positions of the grains (N, 3) [m].
        frames: Pictures of the animation.
        out: Where to: its suffix is replaced.
    """
    if frames == 0:
        return
    from PIL import Image

    # Grains are colored by the layer in which they began: what the ring has mixed shows.
    height, started = states[0][:, 2], scene.time - len(states) / 60.0
    stand = stand_of(size, scene.w.radius, STILL_VOXELS)
    draw(out.with_suffix(".png"), scene, stand, size, states[-1], scene.time, height, STILL_SIZE)
    stand = stand_of(size, scene.w.radius, FRAME_VOXELS)
    chosen = np.unique(np.linspace(0, len(states) - 1, frames).astype(int))
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for i in chosen:
            path = Path(folder) / f"{i}.png"
            draw(path, scene, stand, size, states[i], started + (i + 1) / 60.0, height, FRAME_SIZE)
            with Image.open(path) as image:
                pictures.append(image.convert("RGB").quantize(64, dither=Image.Dither.NONE))
    # GIF counts hundredths of a second.
    pause = max(20, round(1000.0 / 60.0 * len(states) / len(chosen)))
    pictures[0].save(out.with_suffix(".gif"), save_all=True, append_images=pictures[1:], duration=pause, loop=0)


def stand_of(size: float, radius: float, voxels: int) -> Any:
    """The visible part of the bowl: the far half, the whole rim, and a foot.

    Rim and foot also keep the camera still, which frames the bounding box of everything.
    """

    def shape(p: np.ndarray) -> np.ndarray:
        wide = np.hypot(p[:, 0], p[:, 1])
        shell = np.abs(np.hypot(wide, np.minimum(p[:, 2], 0.0)) - size - radius) - radius
        bowl = np.maximum.reduce([shell, p[:, 2] - size / 2.0, p @ CUT])
        rim = np.hypot(wide - size - radius, p[:, 2] - size / 2.0) - radius
        foot = np.maximum(wide - 0.45 * size, np.abs(p[:, 2] + size + 2.0 * radius) - radius)
        return np.minimum.reduce([bowl, rim, foot])

    edge = size + 8.0 * radius
    return gk.volume.from_function(shape, [[-edge] * 3, [edge] * 3], size / voxels)


def draw(
    path: Path,
    scene: Any,
    stand: Any,
    size: float,
    x: np.ndarray,
    at: float,
    value: np.ndarray,
    pixels: tuple[int, int],
    label: str = "height at first [m]",
) -> None:
    """One frame: the ring where it is at that time, the stand, and the grains colored by ``value``."""
    ring = scene.surface.mesh
    posed = gk.mesh.TriangleMesh(ring.vertices @ turned(scene.w.turn * at).T, ring.faces)
    gk.render.figure(
        path,
        mesh=posed,
        volume=stand,
        points=x,
        color="#5d6d7e",
        point_color=value,
        label=label,
        point_size=BOWL_SHARE * pixels[1] * scene.w.radius / size,
        size=pixels,
        up="z",
        colormap="viridis",
    )


class Energy(NamedTuple):
    """Energies of a scene [J], and the power that its dashpots take [W]."""

    kinetic: float
    potential: float
    dissipation: float

    @property
    def total(self) -> float:
        return self.kinetic + self.potential


def touching(scene: Any) -> tuple[np.ndarray, ...]:
    """Gaps [m], normals, relative velocities [m/s] and both grains of all contacts; -1 is the bowl or the mesh."""
    w, x = scene.w, scene.x.numpy().astype(np.float64)
    v = scene.v.numpy().astype(np.float64)
    pairs = gk.points.NeighborGrid(x, 2.0 * w.radius + w.range, device="cpu").pairs()
    i, j = pairs.indices.T
    parts = [(pairs.distance - 2.0 * w.radius, (x[i] - x[j]) / pairs.distance[:, None], v[i] - v[j], i, j)]
    if scene.volume is not None:
        gap, normal = scene.volume.sample(x) - w.radius, scene.volume.gradient(x)
        near = gap < w.range
        parts.append((gap[near], normal[near], v[near], np.flatnonzero(near), np.full(near.sum(), -1)))
    if scene.surface is not None:
        turn = turned(w.turn * scene.time)
        found = scene.surface.closest_point(x @ turn)
        gap, normal = found.distance - w.radius, (x - found.points @ turn.T) / found.distance[:, None]
        near = gap < w.range
        moving = np.cross([0.0, 0.0, w.turn], (found.points @ turn.T)[near])
        parts.append((gap[near], normal[near], v[near] - moving, np.flatnonzero(near), np.full(near.sum(), -1)))
    return tuple(map(np.concatenate, zip(*parts, strict=True)))


def turned(angle: float) -> np.ndarray:
    """Rotation about z; points are rows, so that ``x @ turned(angle)`` turns them back."""
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def energy(scene: Any) -> Energy:
    """Kinetic energy, energy of springs, cohesion and weight, and the dissipated power."""
    w = scene.w
    gap, normal, velocity, _, _ = touching(scene)
    inside, pull = np.maximum(-gap, 0.0), np.clip(w.range - gap, 0.0, w.range)
    springs = 0.5 * w.stiffness * inside**2 - w.cohesion * (0.5 * pull**2 / w.range + inside)
    along = np.sum(velocity * normal, axis=1)
    across = np.linalg.norm(velocity - along[:, None] * normal, axis=1)
    slide = np.minimum(w.damping * across, w.friction * w.stiffness * inside)
    power = np.where(gap < 0.0, w.damping * along**2 + slide * across, 0.0)
    kinetic = 0.5 * w.mass * np.sum(scene.v.numpy().astype(np.float64) ** 2)
    weight = w.mass * w.gravity * np.sum(scene.x.numpy()[:, 2].astype(np.float64))
    return Energy(float(kinetic), float(springs.sum() + weight), float(power.sum()))


def stable_step(scene: Any, rounds: int = 400) -> float:
    """The step [s] at which a vibration of the scene starts to grow, from the contacts as they are now.

    Symplectic Euler lets a mode u grow from the step h on for which u and -u alternate: (h C + h^2 K / 2) u = 2 m u,
    with the matrices K of the springs and C of the dashpots, all of which stick. The least such h belongs to the
    largest eigenvalue; power iteration finds it, h following the Rayleigh quotient of what has been found so far.
    For a pair without dashpots it is 2 / omega.
    """
    w = scene.w
    gap, normal, _, i, j = touching(scene)
    inside = gap < 0.0
    normal, i, j = normal[inside], i[inside], j[inside]
    inner = j >= 0
    mode, step = np.random.default_rng(3).normal(size=(len(scene.x), 3)), scene.step
    for _ in range(rounds):
        mode /= np.linalg.norm(mode)
        stretch = mode[i] - np.where(inner[:, None], mode[j], 0.0)
        along = np.sum(stretch * normal, axis=1)[:, None] * normal
        a, b = w.damping * np.sum(stretch**2), w.stiffness * np.sum(along**2)
        step = (np.sqrt(a * a + 4.0 * w.mass * b) - a) / b
        stretch = step * w.damping * stretch + 0.5 * step**2 * w.stiffness * along
        mode = np.zeros_like(mode)
        np.add.at(mode, i, stretch)
        np.subtract.at(mode, j[inner], stretch[inner])
    return float(step)


def collision_gain(share: float, phases: int = 12) -> tuple[float, float]:
    """Least and greatest speed after a head-on collision without dashpots, as shares of the speed before it.

    The exact value is 1. The result depends on where between two steps the contact begins.
    """
    import granular

    speeds = []
    for phase in np.arange(phases) / phases:
        w = granular.grains(restitution=1.0, bond=0.0, gravity=0.0)
        step = share * critical_step(w)
        x = np.array([[-w.radius - (3.0 + phase) * 0.1 * step, 0.0, 0.0], [w.radius, 0.0, 0.0]])
        scene = granular.Scene(x, w, v=np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]), step=step, device="cpu")
        scene.advance(2 * int(6.0 / share))
        v = scene.v.numpy()[:, 0]
        speeds.append((v[1] - v[0]) / 0.1)
    return float(min(speeds)), float(max(speeds))


def critical_step(w: Any) -> float:
    """2 / omega of two grains on their spring [s]."""
    return float(np.sqrt(2.0 * w.mass / w.stiffness))


def settled(share: float, count: int = CHART_GRAINS) -> Any:
    """A scene without drive whose grains have come to rest."""
    import granular

    w = granular.grains()
    scene, _ = granular.stirred_bowl(count, w, turn=0.0, step=share * critical_step(w), device="cpu")
    while scene.time < 0.25:
        scene.advance(50)
    return scene


def stepped(rest: Any, share: float, seconds: float = 0.05) -> tuple[float, float]:
    """Kinetic energy of a grain [J] and greatest overlap [radii] after going on from rest with another step."""
    import granular

    x, v = rest.x.numpy().copy(), rest.v.numpy().copy()
    step = share * critical_step(rest.w)
    scene = granular.Scene(x, rest.w, v=v, volume=rest.volume, surface=rest.surface, step=step, device="cpu")
    try:
        while scene.time < seconds:
            scene.advance(20)
    except RuntimeError:
        return np.nan, np.nan
    return energy(scene).kinetic / len(x), float(-touching(scene)[0].min() / rest.w.radius)


def account(share: float, count: int = 40, seconds: float = 0.03) -> np.ndarray:
    """Time, kinetic, potential, dissipated energy of grains that fall into the bowl, row after row."""
    import granular

    w = granular.grains()
    started, _ = granular.stirred_bowl(count, w, device="cpu")
    w = granular.grains()
    step = share * critical_step(w)
    scene = granular.Scene(started.x.numpy(), w, volume=started.volume, step=step, device="cpu")
    before = energy(scene)
    rows = [(0.0, before.kinetic, before.potential, 0.0)]
    while scene.time < seconds:
        scene.advance(2)
        now = energy(scene)
        lost = rows[-1][3] + (before.dissipation + now.dissipation) * step
        rows.append((scene.time, now.kinetic, now.potential, lost))
        before = now
    return np.array(rows)


def chart(path: Path) -> None:
    """Energy and overlap against the size of the step, as docs/granular.md shows them."""
    import matplotlib

    matplotlib.use("Agg")
    from granular import STEP_SHARE as default
    from matplotlib import pyplot

    rest = settled(0.1)
    stable = stable_step(rest) / critical_step(rest.w)
    kinetic, overlap = np.array([stepped(rest, share) for share in SHARES]).T
    gains = np.array([collision_gain(share) for share in SHARES])
    books = account(0.1)
    print(f"predicted {stable:.3f}; " + ", ".join(f"{a:.2f}: {b:.1e}" for a, b in zip(SHARES, kinetic, strict=True)))

    figure, axes = pyplot.subplots(2, 2, figsize=(9.6, 6.8))
    for axis in axes.ravel()[:3]:
        axis.axvline(stable, color="#c0392b", linestyle="--", linewidth=1.2, label=f"packing, predicted: {stable:.3f}")
        axis.axvline(default, color="#7f8c8d", linestyle=":", linewidth=1.2, label=f"default: {default:g}")
        axis.set_xlabel("step / (2 / omega of a pair)")
    first, second, third, fourth = axes.ravel()
    first.semilogy(SHARES, kinetic, "o-", markersize=3.5, color="#1f618d")
    first.set(title="packing at rest: does it stay so?", ylabel="kinetic energy a grain after 0.05 s [J]")
    second.plot(SHARES, 100.0 * overlap, "o-", markersize=3.5, color="#1f618d")
    second.set(title="greatest overlap in the packing", ylabel="overlap [% of the radius]")
    third.fill_between(SHARES, *gains.T, color="#aed6f1", label="over 12 phases")
    third.axhline(1.0, color="black", linewidth=0.8)
    third.set(title="collision without dashpots", ylabel="speed after / before", ylim=(0.5, 2.5))
    start = books[0, 2]
    for column, label, color in ((1, "kinetic", "#1f618d"), (3, "dissipated", "#c0392b")):
        fourth.plot(1e3 * books[:, 0], 1e3 * books[:, column], label=label, color=color)
    fourth.plot(1e3 * books[:, 0], 1e3 * (books[:, 2] - start), label="potential", color="#27ae60")
    total = books[:, 1] + books[:, 2] + books[:, 3] - start
    fourth.plot(1e3 * books[:, 0], 1e3 * total, label="sum", color="black", linewidth=1.8)
    fourth.set(title="40 grains fall into the bowl", xlabel="time [ms]", ylabel="change of energy [mJ]")
    for axis in axes.ravel():
        axis.legend(fontsize=8, frameon=False)
        axis.grid(alpha=0.25)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


if __name__ == "__main__":
    chart(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("granular-steps.png"))
