"""Tables of growth: time per query against triangles, ideally near-logarithmic, and time against queries, linear."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks import inputs
from benchmarks.measure import Report, median_seconds
from geokit.mesh import Surface

# Calls with fewer queries than this are short and vary more, so they get more runs.
MANY = 100_000
RUNS_OF_MANY, RUNS_OF_FEW = 3, 20


def grow_triangles(report: Report, queries: int, counts: list[int]) -> None:
    """Bumpy tori of about so many triangles; times of one query among many."""
    report.line("| triangles | build [ms] | closest point [ns] | signed distance [ns] | first hit [ns] |")
    report.line("|---:|---:|---:|---:|---:|")
    for triangles in counts:
        across = round((triangles / 4) ** 0.5)
        mesh = inputs.bumpy_torus(2 * across, across)
        build = median_seconds(partial(Surface, mesh, device="cpu"), RUNS_OF_MANY)
        each = [f"{s / queries * 1e9:,.0f}" for s in call_seconds(Surface(mesh, device="cpu"), queries)]
        report.line(f"| {len(mesh.faces):,} | {build * 1e3:,.1f} | {' | '.join(each)} |")


def grow_queries(report: Report, surface: Surface, named: str, counts: list[int]) -> None:
    """Times of calls of so many queries."""
    report.line(f"| queries, {named} | closest point [ms] | signed distance [ms] | first hit [ms] |")
    report.line("|---:|---:|---:|---:|")
    for queries in counts:
        cells = [f"{s * 1e3:,.2f}" for s in call_seconds(surface, queries)]
        report.line(f"| {queries:,} | {' | '.join(cells)} |")


def powers(first: int, last: int) -> list[int]:
    """Powers of ten, ``first`` among them, up to ``last``."""
    values = [first]
    while values[-1] * 10 <= last:
        values.append(values[-1] * 10)
    return values


def call_seconds(surface: Surface, queries: int) -> list[float]:
    """Seconds of a call for uniform closest points, uniform signed distances and random first hits."""
    points, rays = inputs.uniform(surface.mesh, queries), inputs.random_rays(surface.mesh, queries)
    calls: list[Callable[[], Any]] = [
        partial(surface.closest_point, points),
        partial(surface.signed_distance, points),
        partial(surface.raycast, *rays),
    ]
    return [median_seconds(call, RUNS_OF_MANY if queries >= MANY else RUNS_OF_FEW) for call in calls]
