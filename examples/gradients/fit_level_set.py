"""Optimize the voxels of a level set until its surface goes through the points of a scan, and mesh it.

python examples/gradients/fit_level_set.py [--mesh MESH] [--resolution 48] [--steps 200] [--out fit_level_set.png]

The field begins as the distance to a sphere, so its surface has no handles and the scan may have some. At the scan's
points the field is to be 0 with the scan's normal as its gradient; elsewhere its gradient is to have length 1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"


def scan_of(mesh: gk.mesh.TriangleMesh, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points on a mesh, scaled into the unit ball, and their outward normals."""
    found = gk.mesh.sample_surface(mesh, count, seed=3)
    corners = mesh.vertices[mesh.faces[found.triangle_id]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = 0.5 * (found.points.min(axis=0) + found.points.max(axis=0))
    points = (found.points - middle) / np.linalg.norm(found.points - middle, axis=1).max()
    return torch.tensor(points), torch.tensor(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=SAMPLES / "torus.ply")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--resolution", type=int, default=48, help="voxels along a side")
    parser.add_argument("--count", type=int, default=4000, help="points of the scan")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("fit_level_set.png"))
    arguments = parser.parse_args()

    device = arguments.device
    scan, normals = (rows.to(device) for rows in scan_of(gk.mesh.load(arguments.mesh), arguments.count))
    side = np.linspace(-1.2, 1.2, arguments.resolution)
    size = float(side[1] - side[0])
    centers = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1)
    sphere = (np.linalg.norm(centers, axis=-1) - 0.7).astype(np.float32)
    place = np.diag([size, size, size, 1.0])
    place[:3, 3] = side[0]
    start = gk.volume.from_dense(sphere, transform=place, background=3.0, grid_class="level set", name="fitted")
    active = tuple(torch.tensor(gk.volume.active_voxels(start).coordinates.T, device=device).long())
    # Each voxel is a mean of numbers around it: a field that follows every point alone would be rough between them.
    numbers = torch.tensor(sphere, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([numbers], lr=0.02)
    random = torch.Generator(device=device).manual_seed(0)

    for step in range(arguments.steps):
        smooth = numbers[None]
        for _ in range(2):
            smooth = torch.nn.functional.avg_pool3d(smooth, 3, stride=1, padding=1, count_include_pad=False)
        field = gk.volume.with_values(start, smooth[0][active])
        # Half of the other points are near the scan, where the surface will be.
        near = scan + 0.1 * torch.randn(scan.shape, generator=random, device=device, dtype=scan.dtype)
        far = 2.2 * torch.rand(scan.shape, generator=random, device=device, dtype=scan.dtype) - 1.1
        slope = gk.volume.gradient(field, torch.cat([near, far]).clamp(-1.1, 1.1), device=device)
        through = gk.volume.sample(field, scan, device=device).square().mean()
        turned = (gk.volume.gradient(field, scan, device=device) - normals).square().sum(1).mean()
        length = (slope.norm(dim=1) - 1.0).square().mean()
        loss = 100.0 * through + turned + length
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == arguments.steps - 1:
            print(f"step {step:4}   distance {float(through.detach().sqrt()):.5f}   slope {float(length.detach()):.4f}")

    fitted = gk.mesh.from_volume(gk.volume.with_values(start, smooth[0][active].detach()), device=device)
    parts = gk.mesh.keep_largest(fitted)
    away = gk.mesh.Surface(parts, device=device).closest_point(scan).distance
    print(f"scan to mesh: mean {float(away.mean()):.4f}, worst {float(away.max()):.4f} of the radius")
    print(f"handles: {1 - gk.mesh.audit(parts).euler_number // 2}")
    gk.render.figure(
        arguments.out,
        mesh=parts,
        points=scan.cpu().numpy()[::4],
        point_color=away.cpu().numpy()[::4],
        label="distance",
        point_size=5.0,
    )


if __name__ == "__main__":
    main()
