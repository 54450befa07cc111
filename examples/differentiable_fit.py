"""Fit the pose of a cloud to a mesh by differentiating a level set's distances through a user kernel.

python examples/differentiable_fit.py [--mesh MESH] [--angle 25] [--shift 0.15] [--noise 0.002] [--device cuda:0]

The kernel moves each point by a small turn and shift and samples the level set there; ``wp.Tape`` differentiates it.
Each point has its own turn and shift, so that one backward pass gives all rows of the Jacobian.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np
import warp as wp

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"
# Half width of the band as a share of the size: points farther out have no gradient until they come near.
REACH = 0.3
# Steps below this share of the size no longer change a float32 pose.
SMALLEST_STEP = 1e-6


@wp.func
def turned(turn: wp.vec3f, p: wp.vec3f) -> wp.vec3f:
    """``p`` rotated by the quaternion (turn / 2, 1): for small turns by |turn| around it, and smooth at zero."""
    half = 0.5 * turn
    return wp.quat_rotate(wp.normalize(wp.quatf(half[0], half[1], half[2], 1.0)), p)


@wp.kernel
def distance_kernel(
    volume: wp.uint64,
    center: wp.vec3f,
    points: wp.array(dtype=wp.vec3f),
    turns: wp.array(dtype=wp.vec3f),
    shifts: wp.array(dtype=wp.vec3f),
    out_distance: wp.array(dtype=float),
):
    """Signed distance of each point after its turn around the center and its shift."""
    i = wp.tid()
    moved = center + turned(turns[i], points[i] - center) + shifts[i]
    out_distance[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, moved), wp.Volume.LINEAR)


def residuals(sdf: gk.volume.SparseVolume, points: np.ndarray, center: np.ndarray, device: wp.Device):
    """Distances (N,) and their Jacobian (N, 6) by a small turn and shift of all points."""
    count = len(points)
    moving = wp.array(points, dtype=wp.vec3f, device=device)
    turns = wp.zeros(count, dtype=wp.vec3f, device=device, requires_grad=True)
    shifts = wp.zeros(count, dtype=wp.vec3f, device=device, requires_grad=True)
    distance = wp.zeros(count, dtype=float, device=device, requires_grad=True)
    inputs = [wp.uint64(sdf.id(device)), wp.vec3f(*center), moving, turns, shifts]
    with wp.Tape() as tape:
        wp.launch(distance_kernel, count, inputs=inputs, outputs=[distance], device=device)
    tape.backward(grads={distance: wp.ones(count, dtype=float, device=device)})
    return distance.numpy(), np.hstack([turns.grad.numpy(), shifts.grad.numpy()]).astype(np.float64)


def rotation(turn: np.ndarray) -> np.ndarray:
    """The matrix of the kernel's ``turned``, in float64."""
    x, y, z = 0.5 * np.asarray(turn, dtype=np.float64)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * (skew + skew @ skew) / (1.0 + x * x + y * y + z * z)


def check_gradient(sdf: gk.volume.SparseVolume, points: np.ndarray, center: np.ndarray, device: wp.Device) -> float:
    """Prints the gradient of half the mean squared distance beside central differences of float64 samples."""
    distance, jacobian = residuals(sdf, points, center, device)
    gradient = jacobian.T @ distance / len(points)
    # Much smaller than a voxel: few points change the cell between the two samples, where the field has a kink.
    step = 1e-4 * float(sdf.info.voxel_size[0])
    lever = float(np.ptp(points, axis=0).max())

    def energy(pose: np.ndarray) -> float:
        moved = center + (points - center) @ rotation(pose[:3]).T + pose[3:]
        return 0.5 * float(np.mean(np.asarray(sdf.sample(moved)) ** 2))

    steps = np.diag([step / lever] * 3 + [step] * 3)
    differences = np.array([(energy(h) - energy(-h)) / (2.0 * np.abs(h).max()) for h in steps])
    worst = 0.0
    print("gradient        tape   differences   relative error")
    for at, name in enumerate(("turn x", "turn y", "turn z", "shift x", "shift y", "shift z")):
        scale = np.abs(differences[3 * (at // 3) : 3 * (at // 3) + 3]).max()
        error = abs(gradient[at] - differences[at]) / scale
        worst = max(worst, error)
        print(f"{name:8}{gradient[at]:12.6f}{differences[at]:14.6f}{error:17.1e}")
    return worst


def fit(sdf: gk.volume.SparseVolume, points: np.ndarray, device: wp.Device, truth: np.ndarray) -> np.ndarray:
    """Gauss-Newton with Levenberg damping; returns the final points."""
    size = float(np.ptp(points, axis=0).max())
    background, damping, energy = float(sdf.info.background), 1e-3, np.inf
    moved, best = points, points
    print("\nstep   rms distance   rms to truth   damping")
    for step in range(60):
        center = moved.mean(axis=0)
        distance, jacobian = residuals(sdf, moved, center, device)
        # A constant field gives no direction.
        inside = np.abs(distance) < 0.999 * background
        distance, jacobian = np.where(inside, distance, background), np.where(inside[:, None], jacobian, 0.0)
        now = float(np.mean(distance**2))
        if now < energy:
            best, energy, damping = moved, now, max(0.2 * damping, 1e-9)
            normal, slope = jacobian.T @ jacobian, jacobian.T @ distance
            middle = center
            error = np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1)))
            print(f"{step:4}{np.sqrt(now):15.6f}{error:15.6f}{damping:10.0e}")
        else:
            damping *= 10.0
        pose = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
        moved = middle + (best - middle) @ rotation(pose[:3]).T + pose[3:]
        if np.linalg.norm(pose[:3]) * size + np.linalg.norm(pose[3:]) < SMALLEST_STEP * size:
            break
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=SAMPLES / "bracket.obj")
    parser.add_argument("--resolution", type=int, default=96, help="voxels along the longest side")
    parser.add_argument("--count", type=int, default=4000, help="points of the cloud")
    parser.add_argument("--angle", type=float, default=25.0, help="how far the cloud is turned [degrees]")
    parser.add_argument("--shift", type=float, default=0.15, help="how far it is moved [sizes of the mesh]")
    parser.add_argument("--noise", type=float, default=0.002, help="of the points [sizes of the mesh]")
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--out", type=Path, default=Path("fit.png"))
    arguments = parser.parse_args()

    wp.config.log_level = logging.WARNING  # nothing about the module that is built
    mesh = gk.mesh.load(arguments.mesh)
    size = float(np.ptp(mesh.bounds, axis=0).max())
    voxel = size / arguments.resolution
    surface = gk.mesh.Surface(mesh, device=arguments.device)
    device = wp.get_device(surface.device)
    sdf = gk.volume.from_mesh(surface, voxel, half_width=REACH * size / voxel)

    random = np.random.default_rng(7)
    truth = gk.mesh.sample_surface(mesh, arguments.count, method="poisson_disk", seed=7).points
    truth = truth + random.normal(0.0, arguments.noise * size, truth.shape)
    axis, way = (vector / np.linalg.norm(vector) for vector in random.normal(size=(2, 3)))
    turn = rotation(2.0 * np.tan(np.radians(arguments.angle) / 2.0) * axis)
    start = truth.mean(axis=0) + (truth - truth.mean(axis=0)) @ turn.T + arguments.shift * size * way

    print(f"{mesh.name}: {arguments.count} points, {arguments.angle:g} degrees and {arguments.shift:g} sizes away\n")
    worst = check_gradient(sdf, start, start.mean(axis=0), device)
    print(f"worst {worst:.1e}")
    fitted = fit(sdf, start, device, truth)

    # Remaining pose error: the rigid motion from the fitted to the true points, by Kabsch's method.
    a, b = fitted - fitted.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    left = v.T @ np.diag([1.0, 1.0, np.linalg.det(v.T @ u.T)]) @ u.T
    angle = np.degrees(np.linalg.norm(left - left.T) / np.sqrt(8.0))
    away = np.linalg.norm(fitted.mean(axis=0) - truth.mean(axis=0)) / size
    print("\n             turned [degrees]   moved [sizes]")
    print(f"before{arguments.angle:23.4f}{arguments.shift:16.6f}")
    print(f"after {angle:23.4f}{away:16.6f}")
    draw(mesh, start, fitted, surface, arguments.out)


def draw(
    mesh: gk.mesh.TriangleMesh, start: np.ndarray, fitted: np.ndarray, surface: gk.mesh.Surface, path: Path
) -> None:
    """Before and after, the points colored by their distance."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11.0, 4.4))
    limit = 0.1 * float(np.ptp(mesh.bounds, axis=0).max())
    for axis, title, points in zip(axes, ("before", "after"), (start, fitted), strict=True):
        distance = surface.signed_distance(points).distance
        part = path.with_name(f".{path.stem}-{title}.png")
        gk.render.figure(
            part,
            mesh=mesh,
            color="lightgray",
            opacity=0.25,
            points=points,
            point_color=np.abs(distance),
            colormap="viridis",
            value_limits=(0.0, limit),
            point_size=8.0,
            label="distance",
            size=(900, 720),
            up="z",
        )
        axis.imshow(pyplot.imread(part))
        axis.set_title(title)
        axis.axis("off")
        part.unlink()
    figure.tight_layout()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
