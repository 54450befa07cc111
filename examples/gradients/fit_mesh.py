"""Pull a sphere onto a scan: the vertices of a mesh are optimized until points on it meet the points of the scan.

python examples/gradients/fit_mesh.py [--mesh MESH] [--steps 300] [--out fit_mesh.png]

The loss is the chamfer distance between random points on the mesh and the scan, and two terms that keep the mesh
smooth: lengths of edges, and how far each vertex is from the middle of its neighbors.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"


def scan_of(mesh: gk.mesh.TriangleMesh, count: int) -> torch.Tensor:
    """Points on a mesh, scaled into the unit ball."""
    points = gk.mesh.sample_surface(mesh, count, seed=3).points
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return torch.tensor((points - middle) / np.linalg.norm(points - middle, axis=1).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=SAMPLES / "bracket.obj")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--segments", type=int, default=48, help="of the sphere")
    parser.add_argument("--count", type=int, default=4000, help="points on each side")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("fit_mesh.png"))
    arguments = parser.parse_args()

    device = arguments.device
    scan = scan_of(gk.mesh.load(arguments.mesh), arguments.count).to(device)
    sphere = gk.mesh.sphere(1.0, segments=arguments.segments)
    faces = torch.tensor(sphere.faces.astype(np.int64), device=device)
    edges = torch.unique(torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values, dim=0)
    start = torch.tensor(sphere.vertices, device=device)
    moves = torch.zeros_like(start, requires_grad=True)
    optimizer = torch.optim.Adam([moves], lr=0.02)
    degree = torch.zeros(len(start), 1, dtype=start.dtype, device=device)
    degree.index_add_(0, edges.reshape(-1), torch.ones(edges.numel(), 1, dtype=start.dtype, device=device))

    for step in range(arguments.steps):
        vertices = start + moves
        points = gk.torch.sample_surface(vertices, sphere.faces, arguments.count, seed=step).points
        chamfer = gk.points.chamfer(points, scan, device=device).squared
        along = vertices[edges[:, 0]] - vertices[edges[:, 1]]
        sums = torch.zeros_like(vertices).index_add(0, edges[:, 0], -along).index_add(0, edges[:, 1], along)
        smooth = (sums / degree).square().sum(1).mean()
        loss = chamfer + 0.02 * along.square().sum(1).mean() + 0.5 * smooth
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == arguments.steps - 1:
            print(f"step {step:4}   chamfer {float(chamfer.detach()):.6f}")

    fitted = gk.mesh.TriangleMesh((start + moves).detach().cpu().numpy(), sphere.faces, name="fitted")
    away = gk.mesh.Surface(fitted, device=device).closest_point(scan).distance
    print(f"scan to mesh: mean {float(away.mean()):.4f}, worst {float(away.max()):.4f} of the radius")
    gk.render.figure(
        arguments.out,
        mesh=fitted,
        points=scan.cpu().numpy()[::4],
        point_color=away.cpu().numpy()[::4],
        label="distance",
        point_size=5.0,
    )


if __name__ == "__main__":
    main()
