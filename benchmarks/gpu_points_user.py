"""User kernels on a GPU against the CPU: each program of docs/kernels.md, and the fit by gradients.

Run with ``python -m benchmarks.gpu_points_user``. Needs a GPU; numpy, warp and geokit, nothing else.
"""

from __future__ import annotations

import importlib.util
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import warp as wp

import geokit as gk
from benchmarks.gpu_timing import wall_median

ROOT = Path(__file__).resolve().parents[1]
Out = Callable[[str], None]
REPEATS = 5
FIT_POINTS = 1_000_000


def load_module(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def page_blocks(folder: Path) -> dict[str, ModuleType]:
    """Each code block of the page, run on the first GPU; warp reads the source of kernels from a file."""
    text = (ROOT / "docs" / "kernels.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n# (\w+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    modules = {}
    before = os.getcwd()
    os.chdir(ROOT)
    try:
        for name, code in blocks:
            path = folder / f"page_{name}.py"
            path.write_text(code, encoding="utf-8")
            modules[name] = load_module(f"page_{name}", path)
    finally:
        os.chdir(before)
    return modules


def largest(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.max(np.abs(np.asarray(found, np.float64) - expected)))


def check_page(out: Out) -> None:
    """Answers of the page's kernels on the GPU against geokit's float64 answers on the CPU."""
    with tempfile.TemporaryDirectory() as folder:
        page = page_blocks(Path(folder))
    on = {str(module.distance.device) for module in (page["mesh"], page["volume"])}
    out(f"\n## The programs of docs/kernels.md on {', '.join(sorted(on))}\n")
    out("| program | answers | largest difference from geokit on the CPU |\n|---|---|---|")

    mesh = page["mesh"]
    expected = gk.mesh.Surface(mesh.torus, device="cpu").closest_point(mesh.points).distance
    out(f"| mesh | distance | {largest(mesh.distance.numpy(), expected):.1e} |")

    volume = page["volume"]
    single = volume.points.astype(np.float32).astype(np.float64)
    expected = volume.sdf.sample(single, device="cpu")
    out(f"| volume | distance | {largest(volume.distance.numpy(), expected):.1e} |")

    grid = page["grid"]
    counts = gk.points.NeighborGrid(grid.points, radius=0.1, device="cpu").count(grid.points)
    out(f"| grid | neighbors | {int(np.abs(grid.count.numpy() - counts).max())} |")

    every = page["all"]
    pushes = every.push.numpy()
    other = wp.empty(len(every.points), dtype=wp.vec3f, device="cpu")
    run_push_on_cpu(every, other)
    out(f"| all | push (the same kernel on the CPU) | {largest(pushes, other.numpy()):.1e} |")


def run_push_on_cpu(page: ModuleType, push: "wp.array") -> None:
    surface = gk.mesh.Surface(page.torus, device="cpu")
    grid = gk.points.NeighborGrid(page.points, 2.0 * page.radius, device="cpu")
    inputs = [
        wp.uint64(grid.id),
        wp.uint64(surface.id),
        wp.vec3d(*surface.origin),
        wp.float64(surface.scale),
        wp.uint64(page.room.id("cpu")),
        float(page.room.info.voxel_size[0]),
        page.radius,
        wp.array(page.points, dtype=wp.vec3f, device="cpu"),
    ]
    wp.launch(page.push_kernel, dim=len(page.points), inputs=inputs, outputs=[push], device="cpu")


def check_fit(out: Out) -> None:
    """Residuals and their Jacobian through wp.Tape on both devices; seconds for a million points."""
    fit = load_module("differentiable_fit", ROOT / "examples" / "differentiable_fit.py")
    bracket = gk.mesh.load(ROOT / "data" / "samples" / "bracket.obj")
    sdf = gk.volume.from_mesh(bracket, 0.5, half_width=20.0, device="cpu")
    random = np.random.default_rng(1)
    points = gk.mesh.sample_surface(bracket, 20_000, seed=1).points + random.normal(0.0, 1.0, (20_000, 3))
    center = points.mean(axis=0)
    gpu, cpu = wp.get_device("cuda:0"), wp.get_device("cpu")
    distance, jacobian = fit.residuals(sdf, points, center, gpu)
    expected_distance, expected_jacobian = fit.residuals(sdf, points, center, cpu)
    # The gradient jumps at the face of a cell, where both sides are right.
    apart = np.abs(jacobian - expected_jacobian).max(axis=1)
    out("\n## Residuals and Jacobian by wp.Tape (examples/differentiable_fit.py), GPU against CPU\n")
    out("| | largest difference | 99.9% of the points |\n|---|---|---|")
    off = np.abs(distance - expected_distance)
    out(f"| distance (size 40) | {off.max():.1e} | {np.quantile(off, 0.999):.1e} |")
    out(f"| Jacobian (up to {np.abs(jacobian).max():.0f}) | {apart.max():.1e} | {np.quantile(apart, 0.999):.1e} |")

    many = np.resize(points, (FIT_POINTS, 3))
    seconds = {
        str(device): wall_median(lambda device=device: fit.residuals(sdf, many, center, device), runs)
        for device, runs in ((gpu, REPEATS), (cpu, 1))
    }
    out("\n| device | seconds for a million points, copies to and from the host included |\n|---|---|")
    for device, taken in seconds.items():
        out(f"| {device} | {taken:.4f} |")


def main(out: Out = print) -> None:
    check_page(out)
    check_fit(out)


if __name__ == "__main__":
    main()
