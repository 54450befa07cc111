"""Training samples of a distance field from any mesh: points, signed distances and their gradients in one .npz file.

python examples/gradients/sdf_training_samples.py MESH [--count 100000] [--out samples.npz] [--figure samples.png]

Most samples lie near the surface, where a network has to be right: half about 0.5 % of the size away, a third 5 %, the
rest anywhere in the box. The sign is that of the winding number, so holes, inner faces and overlapping parts do no
harm; how sure it is stands beside each sample.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"
# Shares of the samples, and the standard deviation of their distance [sizes of the mesh].
STRATA = ((1 / 2, 0.005), (1 / 3, 0.05))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, nargs="?", default=SAMPLES / "broken.obj")
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--out", type=Path, default=Path("samples.npz"))
    parser.add_argument("--figure", type=Path, default=Path("samples.png"))
    arguments = parser.parse_args()

    mesh = gk.mesh.load(arguments.mesh)
    surface = gk.mesh.Surface(mesh, device=arguments.device)
    low, high = mesh.bounds
    size, random = float((high - low).max()), np.random.default_rng(arguments.seed)
    groups = []
    for number, (share, spread) in enumerate(STRATA):
        on = gk.mesh.sample_surface(mesh, round(share * arguments.count), seed=arguments.seed + number).points
        groups.append(on + spread * size * random.normal(size=on.shape))
    rest = arguments.count - sum(map(len, groups))
    groups.append(low - 0.1 * size + (high - low + 0.2 * size) * random.random((rest, 3)))
    points = np.vstack(groups)

    found = surface.signed_distance(points, sign="winding")
    away = points - found.points
    length = np.linalg.norm(away, axis=1, keepdims=True)
    gradient = np.divide(away * np.sign(found.distance)[:, None], length, out=np.zeros_like(away), where=length > 0.0)
    confidence = surface.sign_confidence(points)
    np.savez_compressed(
        arguments.out,
        points=points.astype(np.float32),
        distance=found.distance.astype(np.float32),
        gradient=gradient.astype(np.float32),
        sign_confidence=confidence.astype(np.float32),
    )
    inside = float((found.distance < 0.0).mean())
    unsure = float((confidence < 0.1).mean())
    print(f"{arguments.out}: {len(points)} samples, {inside:.1%} inside, sign unsure for {unsure:.2%}")
    half = points[:, 1] > 0.5 * (low[1] + high[1])
    gk.render.figure(
        arguments.figure,
        points=points[half][::4],
        point_color=found.distance[half][::4],
        label="signed distance",
        point_size=4.0,
    )


if __name__ == "__main__":
    main()
