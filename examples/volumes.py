"""A tour of volumes: a mesh becomes a level set, is raycast, measured, smoothed, cut and stored compactly.

python examples/volumes.py [MESH] [--smoke FILE.vdb] [--resolution 160] [--out volumes.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"
LIGHT = np.array([0.4, 0.6, 0.7])


def picture_rays(bounds: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Parallel rays along -z through a square around the box, row by row."""
    center, size = bounds.mean(axis=0), 1.15 * float(np.ptp(bounds, axis=0).max())
    across = np.linspace(-0.5, 0.5, pixels) * size
    x, y = np.meshgrid(across, -across)
    origins = np.stack([center[0] + x, center[1] + y, np.full_like(x, center[2] + 2.0 * size)], axis=-1).reshape(-1, 3)
    return origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1))


def shaded(volume: gk.volume.SparseVolume, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Brightness of the surface where each ray hits it; NaN for misses."""
    hits = volume.raycast(origins, directions)
    return np.clip(hits.normals @ LIGHT, 0.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?", type=Path, default=SAMPLES / "bracket.obj")
    parser.add_argument("--smoke", type=Path, default=SAMPLES / "smoke.vdb")
    parser.add_argument("--resolution", type=int, default=160, help="voxels along the longest side")
    parser.add_argument("--pixels", type=int, default=240)
    parser.add_argument("--out", type=Path, default=Path("volumes.png"))
    arguments = parser.parse_args()

    mesh = gk.mesh.load(arguments.mesh)
    size = float(np.ptp(mesh.bounds, axis=0).max())
    solid = gk.volume.from_mesh(mesh, size / arguments.resolution)
    origins, directions = picture_rays(solid.info.world_bounds, arguments.pixels)
    pictures = {"level set": shaded(solid, origins, directions)}

    # Properties of the field where the rays hit.
    hits = solid.raycast(origins, directions)
    met = np.isfinite(hits.t)
    mean = np.full(len(origins), np.nan)
    mean[met] = np.clip(solid.curvature(hits.points[met]).mean * size, -30.0, 30.0)
    pictures["mean curvature"] = mean

    # Operations return volumes: flow, offset, and the difference to a ball given by a function.
    smooth = gk.volume.smooth(solid, "mean_curvature", iterations=arguments.resolution // 10)
    pictures["mean curvature flow"] = shaded(smooth, origins, directions)
    middle = np.append(mesh.bounds.mean(axis=0)[:2], mesh.bounds[1, 2])

    def ball(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - middle, axis=1) - 0.3 * size

    box = np.stack([middle - 0.4 * size, middle + 0.4 * size])
    cut = gk.volume.difference(solid, gk.volume.from_function(ball, box, solid.info.voxel_size[0]), smooth=0.0)
    pictures["less a ball"] = shaded(cut, origins, directions)

    smoke = gk.volume.load(arguments.smoke, grid="density")
    origins, directions = picture_rays(smoke.info.world_bounds, arguments.pixels)
    deep = 4.0 / float(np.ptp(smoke.info.world_bounds, axis=0).max())
    light = smoke.integrate(origins, directions, extinction=deep, emission=smoke)
    pictures["transmittance"], pictures["emission"] = map(np.asarray, light)

    # Back to a mesh, and to a file with a tolerance of a hundredth of a voxel.
    back = gk.mesh.from_volume(cut)
    small = solid.quantize(tolerance=0.01 * float(solid.info.voxel_size[0]))
    print(f"{mesh.name}: {len(mesh.faces)} triangles, {solid.info.active_voxel_count} active voxels")
    print(f"less a ball: {len(back.faces)} triangles, watertight {gk.mesh.audit(back).watertight}")
    print(f"stored as {small.info.grid_type}: {small.info.byte_count / solid.info.byte_count:.0%} of the bytes")
    measured = gk.volume.statistics(solid)
    print(f"area {measured.area:.4g}, volume {measured.volume:.4g}")
    draw(pictures, arguments.pixels, arguments.out)


def draw(pictures: dict[str, np.ndarray], pixels: int, path: Path) -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(9.0, 6.4))
    for axis, (title, values) in zip(axes.ravel(), pictures.items(), strict=True):
        colors = "coolwarm" if title == "mean curvature" else "gray"
        axis.imshow(values.reshape(pixels, pixels), cmap=colors)
        axis.set_title(title)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=70)


if __name__ == "__main__":
    main()
