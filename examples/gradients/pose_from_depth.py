"""Find where a camera stood from its depth image: the pose is optimized until rays hit the mesh at the depths seen.

python examples/gradients/pose_from_depth.py [--mesh MESH] [--angle 8] [--out pose.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import geokit as gk

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"


def turned(turn: torch.Tensor) -> torch.Tensor:
    """The rotation matrix of a turn: axis times angle."""
    x, y, z = turn
    none = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([none, -z, y, z, none, -x, -y, x, none]).reshape(3, 3))


def view_from(eye: np.ndarray, target: np.ndarray, width: int) -> np.ndarray:
    """Directions (W, W, 3) of a camera's pixels, of length 1 along its axis: t is the depth."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    at = np.linspace(-0.35, 0.35, width)
    return ahead + at[None, :, None] * right - at[:, None, None] * np.cross(right, ahead)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=SAMPLES / "bracket.obj")
    parser.add_argument("--angle", type=float, default=8.0, help="error of the first guess [degrees]")
    parser.add_argument("--shift", type=float, default=0.05, help="error of the first guess [sizes of the mesh]")
    parser.add_argument("--width", type=int, default=64, help="pixels")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("pose.png"))
    arguments = parser.parse_args()

    device, mesh = arguments.device, gk.mesh.load(arguments.mesh)
    surface = gk.mesh.Surface(mesh, device=device)
    low, high = mesh.bounds
    size, middle = float((high - low).max()), 0.5 * (low + high)
    eye = middle + size * np.array([1.3, -1.6, 1.1])
    directions = view_from(eye, middle, arguments.width).reshape(-1, 3)
    seen = torch.tensor(surface.raycast(np.broadcast_to(eye, directions.shape).copy(), directions).t, device=device)

    random = np.random.default_rng(5)
    axis, way = (vector / np.linalg.norm(vector) for vector in random.normal(size=(2, 3)))
    rays, true_eye = torch.tensor(directions, device=device), torch.tensor(eye, device=device)
    # The guess is the true pose after a turn and a shift, which are to be undone.
    first_turn = torch.tensor(np.radians(arguments.angle) * axis, device=device)
    first_shift = torch.tensor(arguments.shift * size * way, device=device)
    turn, shift = (torch.zeros(3, dtype=torch.float64, device=device, requires_grad=True) for _ in range(2))
    optimizer = torch.optim.Adam([turn, shift], lr=0.01)

    def pose() -> tuple[torch.Tensor, torch.Tensor]:
        return turned(turn) @ turned(first_turn), true_eye + first_shift + size * shift

    def cast() -> torch.Tensor:
        rotation, origin = pose()
        return torch.as_tensor(surface.raycast(origin.expand(len(rays), 3), rays @ rotation.T).t)

    def errors() -> str:
        rotation, origin = pose()
        angle = torch.arccos(((rotation.detach().trace() - 1.0) / 2.0).clamp(-1.0, 1.0))
        away = float((origin.detach() - true_eye).norm()) / size
        return f"{np.degrees(float(angle)):9.4f} degrees {away:9.6f} sizes"

    print(f"before {errors()}")
    before = cast().detach()
    for step in range(arguments.steps):
        depth = cast()
        # Of pixels that see the mesh in both images; large differences are other parts of the mesh and count less.
        both = torch.isfinite(depth) & torch.isfinite(seen)
        away = (depth[both] - seen[both]) / size
        loss = torch.log1p((away / 0.02).square()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        for group in optimizer.param_groups:
            group["lr"] *= 0.985
        if step % 50 == 0:
            print(f"step {step:4}   loss {float(loss.detach()):.6f}")
    print(f"after  {errors()}")
    draw([seen, before, cast().detach()], arguments.width, arguments.out)


def draw(depths: list[torch.Tensor], width: int, path: Path) -> None:
    """Depth images: seen, guessed, found."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(12.0, 4.2))
    for axis, title, depth in zip(axes, ("seen", "first guess", "found"), depths, strict=True):
        image = np.ma.masked_invalid(depth.cpu().numpy().reshape(width, width))
        axis.imshow(image, cmap="viridis_r")
        axis.set_title(title)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
