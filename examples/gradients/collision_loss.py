"""Bend a path around an obstacle: a ball is moved until it keeps a clearance from a scene.

python examples/gradients/collision_loss.py [--steps 300] [--out path.png]

The path is a row of positions of a ball of points. The loss is its length, plus what its points lack in clearance by
the scene's distance field.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import geokit as gk


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--poses", type=int, default=32)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("path.png"))
    arguments = parser.parse_args()

    device = arguments.device
    scene = gk.mesh.torus(1.0, 0.35, segments=96, tube_segments=48)
    field = gk.volume.from_mesh(scene, 0.03, half_width=16, device=device)
    body = torch.tensor(gk.mesh.sample_surface(gk.mesh.sphere(0.2), 60, method="poisson_disk").points, device=device)
    begin, end = (torch.tensor(at, dtype=torch.float64, device=device) for at in ([1.0, 0.0, -1.0], [0.9, 0.3, 1.0]))
    share = torch.linspace(0.0, 1.0, arguments.poses, dtype=torch.float64, device=device)[1:-1, None]
    path = (begin + share * (end - begin)).requires_grad_()
    optimizer = torch.optim.Adam([path], lr=0.01)
    clearance = 0.05

    def distances() -> torch.Tensor:
        points = path[:, None] + body
        return gk.volume.sample(field, points.reshape(-1, 3), order=1, device=device).reshape(len(path), -1)

    print(f"before: least distance {float(distances().detach().min()):.3f}")
    first = path.detach().clone()
    for step in range(arguments.steps):
        whole = torch.cat([begin[None], path, end[None]])
        bends = whole[:-2] - 2.0 * whole[1:-1] + whole[2:]
        pieces = (whole[1:] - whole[:-1]).square().sum(1).sum()
        lacking = torch.relu(clearance - distances()).square().sum(1).sum()
        loss = pieces + 20.0 * bends.square().sum() + 30.0 * lacking
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 0:
            print(f"step {step:4}   loss {float(loss.detach()):.4f}")

    found = path.detach()
    exact = gk.mesh.Surface(scene, device=device).signed_distance((found[:, None] + body).reshape(-1, 3)).distance
    print(f"after: least distance {float(exact.min()):.3f}, by the exact mesh")
    balls = [gk.mesh.transform(gk.mesh.sphere(0.2, segments=24), placed(at)) for at in found.cpu().numpy()[::3]]
    vertices = np.vstack([scene.vertices, *(ball.vertices for ball in balls)])
    starts = np.cumsum([0, scene.vertex_count, *(ball.vertex_count for ball in balls)])
    parts = [mesh.faces + start for mesh, start in zip([scene, *balls], starts, strict=False)]
    gk.render.figure(
        arguments.out, mesh=gk.mesh.TriangleMesh(vertices, np.vstack(parts)), opacity=0.6, points=first.cpu().numpy()
    )


def placed(at: np.ndarray) -> np.ndarray:
    """The matrix that moves the origin to a place."""
    matrix = np.eye(4)
    matrix[:3, 3] = at
    return matrix


if __name__ == "__main__":
    main()
