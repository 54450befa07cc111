"""Gradients through torch beside plain calls, warp's tape and torch alone: ``python -m benchmarks.gradients``.

Options: ``--device cuda:0``, ``--queries N``. Each row has medians of runs after a warm-up, made in turn, so that what
slows the host for a while slows all. Answers and gradients are compared first.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import warp as wp

import geokit as gk
from benchmarks.raw_tape_kernels import tape_closest_kernel, tape_sample_kernel

RUNS = 25
# Answers of float32 kernels and gradients of float64 ones agree to this share of a unit slope.
SAME = 2e-3


def medians(*runs: Callable[[], Any]) -> list[float]:
    seconds: list[list[float]] = [[] for _ in runs]
    for number in range(RUNS + 2):
        for run, taken in zip(runs, seconds, strict=True):
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            start = time.perf_counter()
            run()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if number > 1:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def compared(name: str, query: Callable[[Any], Any], points: Any, tape: Callable[[], Any] | None) -> None:
    """One row: plain call, forward and backward with gradients, and warp's tape."""
    asked = points.clone().requires_grad_()
    ones = torch.ones_like(query(points))
    ours = (lambda: query(points), lambda: query(asked), lambda: torch.autograd.grad(query(asked), asked, ones))
    plain, forward, both, *taped = medians(*ours, *([] if tape is None else [tape]))
    line = f"| {name} | {plain * 1e3:.3f} | {forward / plain:.2f} | {(both - forward) / forward:.2f} |"
    if tape is None:
        print(line, "|")
        return
    (slope,) = torch.autograd.grad(query(asked), asked, ones)
    other = tape()
    far = (slope - other).norm(dim=1)
    # At ties and kinks two triangles or cells are as good.
    share = float((far > SAME).float().mean())
    print(line, f"{taped[0] / both:.2f}, {share:.1e} of the gradients differ |")


def tape_of(kernel: Any, handle: Any, points: Any) -> Callable[[], Any]:
    def run() -> Any:
        rows = wp.from_torch(points.float().contiguous(), dtype=wp.vec3, requires_grad=True)
        out = wp.zeros(len(rows), dtype=float, device=rows.device, requires_grad=True)
        with wp.Tape() as tape:
            wp.launch(kernel, len(rows), [handle, rows], [out], device=rows.device)
        out.grad.fill_(1.0)
        tape.backward()
        return wp.to_torch(rows.grad).double()

    return run


def by_vertices(body: gk.mesh.TriangleMesh, points: Any, device: str) -> None:
    """Backward passes of closest points by the vertices, through torch and on a tape, after their sums are compared."""
    held = torch.tensor(body.vertices, device=device, requires_grad=True)
    distance = gk.mesh.Surface((held, body.faces), device=device).closest_point(points).distance
    ones = torch.ones_like(distance)
    vertices, rows = (wp.from_torch(part.detach().contiguous(), dtype=wp.vec3d) for part in (held, points))
    vertices.requires_grad = True
    with wp.Tape() as tape:
        answer = gk.mesh.Surface((vertices, body.faces), device=device).closest_point(rows)

    def on_tape() -> Any:
        vertices.grad.zero_()
        answer.distance.grad.fill_(1.0)
        tape.backward()
        return wp.to_torch(vertices.grad)

    def in_torch() -> Any:
        return torch.autograd.grad(distance, held, ones, retain_graph=True)[0]

    far = float((in_torch() - on_tape()).abs().max() / in_torch().abs().max())
    by_torch, by_tape = medians(in_torch, on_tape)
    print(
        f"\nclosest points by vertices, backward: {by_torch * 1e3:.2f} ms in torch, {by_tape * 1e3:.2f} on warp's tape"
    )
    print(f"largest difference {far:.1e} of the largest gradient")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--queries", type=int, default=1_000_000)
    options = parser.parse_args()
    device, count, random = options.device, options.queries, np.random.default_rng(0)
    print(f"torch {torch.__version__}, warp {wp.__version__}, {wp.get_device(device).name}, {count} queries\n")
    print("| query | plain [ms] | forward / plain | backward / forward | warp's tape / forward and backward |")
    print("|---|---:|---:|---:|---:|")

    body = gk.mesh.load("data/samples/bracket.obj")
    surface = gk.mesh.Surface(body, device=device)
    low, high = body.bounds
    points = torch.tensor(low + (high - low) * random.random((count, 3)), device=device)
    vertices = wp.array(body.vertices.astype(np.float32), dtype=wp.vec3, device=device)
    raw = wp.Mesh(vertices, wp.array(body.faces.ravel(), dtype=int, device=device))
    tape = tape_of(tape_closest_kernel, raw.id, points)
    compared("closest point", lambda p: surface.closest_point(p).distance, points, tape)
    compared("signed distance", lambda p: surface.signed_distance(p).distance, points, None)
    rays = torch.tensor(random.standard_normal((count, 3)), device=device)
    compared(
        "first hit (t), by origins", lambda p: torch.nan_to_num(surface.raycast(p, rays).t, posinf=0.0), points, None
    )

    field = gk.volume.from_mesh(body, (high - low).max() / 200, device=device)
    near = surface.closest_point(points).points + 0.4 * float(field.info.voxel_size[0]) * rays
    tape = tape_of(tape_sample_kernel, wp.uint64(field.id(device)), near)
    for order in (1, 2, 3):
        compared(
            f"sample, order {order}",
            lambda p, o=order: gk.volume.sample(field, p, order=o, device=device),
            near,
            tape if order == 1 else None,
        )

    by_vertices(body, points, device)
    few = min(count, 20_000)
    a, b = points[:few].clone().requires_grad_(), near[:few].clone()

    def ours() -> Any:
        return torch.autograd.grad(gk.points.chamfer(a, b, device=device).squared, a)[0]

    def alone() -> Any:
        away = torch.cdist(a, b)
        return torch.autograd.grad((away.amin(0) ** 2).mean() + (away.amin(1) ** 2).mean(), a)[0]

    far = float((ours() - alone()).abs().max() / alone().abs().max())
    by_torch, by_geokit = medians(alone, ours)
    ratio = by_torch / by_geokit
    print(f"\nchamfer of {few} points, forward and backward: {ratio:.1f} times the rate of torch.cdist")
    print(f"largest difference {far:.1e} of the largest gradient")


if __name__ == "__main__":
    main()
