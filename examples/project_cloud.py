"""Compare a scan with its part: closest points on the mesh, signed distances, and a figure of the deviations.

python examples/project_cloud.py [CLOUD] [--mesh MESH] [--tolerance 0.3] [--device cuda:0] [--out scan]

Without a cloud a scan is generated: the sampled mesh, with a dent in one place and scanner noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[1] / "data" / "samples"
# Generated scan, in shares of the part's size: position, radius and depth of the dent, and the scanner's noise.
DENT, DENT_RADIUS, DENT_DEPTH, NOISE = (0.8, 0.25, 0.15), 0.2, 0.02, 0.002


def made_up_scan(mesh: gk.mesh.TriangleMesh, count: int, seed: int = 1) -> gk.points.PointCloud:
    """Points on the mesh with its normals, pushed in around one place and moved along the normals by noise."""
    random = np.random.default_rng(seed)
    size = float(np.ptp(mesh.bounds, axis=0).max())
    samples = gk.mesh.sample_surface(mesh, count, method="poisson_disk", seed=seed)
    normals = face_normals(mesh)[samples.triangle_id]
    middle = np.argmin(np.linalg.norm(samples.points - (mesh.bounds[0] + DENT * np.ptp(mesh.bounds, axis=0)), axis=1))
    far = np.linalg.norm(samples.points - samples.points[middle], axis=1) / (DENT_RADIUS * size)
    # Only the side that was hit: on a thin plate the other side is as near.
    depth = DENT_DEPTH * size * np.clip(1.0 - far**2, 0.0, None) ** 2 * (normals @ normals[middle] > 0.5)
    moved = samples.points + normals * (random.normal(0.0, NOISE * size, count) - depth)[:, None]
    return gk.points.PointCloud(moved, {"normals": normals})


def face_normals(mesh: gk.mesh.TriangleMesh) -> np.ndarray:
    """Unit normal of each face; zero where a face has no area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


def report(distance: np.ndarray, tolerance: float) -> None:
    outside, inside = distance > tolerance, distance < -tolerance
    print(f"{'points':24}{len(distance):10d}")
    print(f"{'mean':24}{distance.mean():10.4f}")
    print(f"{'root mean square':24}{np.sqrt(np.mean(distance**2)):10.4f}")
    for share in (5, 50, 95):
        print(f"{f'{share}th percentile':24}{np.percentile(distance, share):10.4f}")
    print(f"{'least, greatest':24}{distance.min():10.4f}{distance.max():10.4f}")
    print(f"{f'more than {tolerance:g} outside':24}{outside.mean():10.1%}")
    print(f"{f'more than {tolerance:g} inside':24}{inside.mean():10.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cloud", nargs="?", type=Path, help="any point file; made up if there is none")
    parser.add_argument("--mesh", type=Path, default=SAMPLES / "bracket.obj")
    parser.add_argument("--tolerance", type=float, help="deviation that is still good [world]; 1%% of the size if none")
    parser.add_argument("--count", type=int, default=20_000, help="points of the made-up scan")
    parser.add_argument("--device", help="cpu, cuda:0, ...; the first GPU if there is one")
    parser.add_argument("--out", type=Path, default=Path("scan"), help="writes OUT.png and OUT.vtp")
    arguments = parser.parse_args()

    mesh = gk.mesh.load(arguments.mesh)
    cloud = gk.points.load(arguments.cloud) if arguments.cloud else made_up_scan(mesh, arguments.count)
    tolerance = arguments.tolerance or 0.01 * float(np.ptp(mesh.bounds, axis=0).max())

    surface = gk.mesh.Surface(mesh, device=arguments.device)
    found = surface.signed_distance(cloud.points)
    normals = face_normals(mesh)[found.triangle_id]
    print(f"{mesh.name}: {len(mesh.faces)} faces, signs by {surface.sign_method}, on {surface.device}")
    report(np.asarray(found.distance), tolerance)
    if cloud.data.get("normals", np.empty(0)).shape == normals.shape:
        turned = np.einsum("ij,ij->i", cloud.data["normals"], normals)
        print(f"{'normals within 30 deg':24}{np.mean(turned > np.cos(np.radians(30.0))):10.1%}")

    data = {"distance": found.distance, "foot": found.points, "triangle_id": found.triangle_id, "normals": normals}
    gk.points.save(arguments.out.with_suffix(".vtp"), cloud.points, data=data)
    gk.render.figure(
        arguments.out.with_suffix(".png"),
        points=cloud.points,
        color=found.distance,
        point_size=5.0,
        colormap="coolwarm",
        value_limits=(-2.0 * tolerance, 2.0 * tolerance),
        label="signed distance",
        size=(1000, 750),
        up="z",
    )
    print(f"wrote {arguments.out.with_suffix('.vtp')} and {arguments.out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
