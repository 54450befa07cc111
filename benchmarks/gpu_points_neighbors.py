"""Radius search on a GPU: comparison with the CPU, and times against raw ``wp.HashGrid`` in point and grid order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks import clouds
from benchmarks.gpu_timing import device_median, wall_median
from benchmarks.raw_kernels import raw_count_in_order_kernel, raw_count_kernel
from geokit.points import NeighborGrid

CHECKED = 100_000
COUNT = 4_000_000
RUNS = 11
# Cells of the peer's table on an axis: the fastest of 128, 256 and 512 at this number of points.
TABLE = 256


def main(out: Callable[[str], None]) -> None:
    device = wp.get_preferred_device().alias
    out(f"Device: {wp.get_device(device).name}\n")
    check(device, out)
    against_raw(device, out)
    shapes(device, out)


def check(device: str, out: Callable[[str], None]) -> None:
    out("| CPU and GPU | queries | neighbors | lists that differ |")
    out("|---|---:|---:|---:|")
    for name, make in clouds.SHAPES.items():
        for offset in (0.0, 1e6):
            points, radius = make(CHECKED)
            points = points + offset
            a, b = (NeighborGrid(points, radius, device=d) for d in ("cpu", device))
            answers = [[*g.radius_search(), *g.pairs(), g.count(exclude_self=True)] for g in (a, b)]
            differ = sum(not np.array_equal(x, y) for x, y in zip(*answers, strict=True))
            out(f"| {name}, offset {offset:g} | {CHECKED:,} | {len(answers[0][1]):,} | {differ} |")
    points, radius = clouds.uniform(CHECKED)
    radii = radius * np.random.default_rng(5).random(CHECKED) * 2
    found = [
        NeighborGrid(points, radius, device=d).radius_search(points, radius=radii, order="distance")
        for d in ("cpu", device)
    ]
    differ = sum(not np.array_equal(x, y) for x, y in zip(*found, strict=True))
    out(f"| a radius for each query, by distance | {CHECKED:,} | {len(found[0].indices):,} | {differ} |")


def against_raw(device: str, out: Callable[[str], None]) -> None:
    points, radius = clouds.uniform(COUNT)
    out(f"\n{COUNT:,} points in random order, radius count, build included; ms by the wall clock (device clock)\n")
    out("| points | geokit both | build | count | raw warp both, point order | ratio | grid order | ratio |")
    out("|---|---:|---:|---:|---:|---:|---:|---:|")
    single = wp.array(points, dtype=wp.vec3, device=device)
    hashed = wp.HashGrid(TABLE, TABLE, TABLE, device=device)
    counts = wp.empty(COUNT, dtype=wp.int32, device=device)

    def raw(kernel: wp.Kernel) -> None:
        hashed.build(single, radius)
        wp.launch(kernel, COUNT, [hashed.id, single, radius], [counts], device=device)

    peers = [
        (wall_median(lambda k=k: raw(k), RUNS), device_median(lambda k=k: raw(k), RUNS))
        for k in (raw_count_kernel, raw_count_in_order_kernel)
    ]
    for label, dtype in (("float32", wp.vec3f), ("float64", wp.vec3d)):
        given = wp.array(points, dtype=dtype, device=device)
        kept = NeighborGrid(given, radius, device=device)
        both = lambda given=given: NeighborGrid(given, radius, device=device).count()  # noqa: E731
        wall, clock = wall_median(both, RUNS, warm=3), device_median(both, RUNS)
        build = wall_median(lambda given=given: NeighborGrid(given, radius, device=device), RUNS)
        count = wall_median(lambda kept=kept: kept.count(), RUNS)
        cells = [f"{wall * 1e3:.2f} ({clock * 1e3:.2f})", f"{build * 1e3:.2f}", f"{count * 1e3:.2f}"]
        for other_wall, other_clock in peers:
            cells += [f"{other_wall * 1e3:.2f} ({other_clock * 1e3:.2f})", f"{other_wall / wall:.2f}"]
        out(f"| {label} | " + " | ".join(cells) + " |")
        if dtype is wp.vec3f:
            differ = int((kept.count().numpy() != counts.numpy()).sum())
            out(f"\nCounts that differ from the peer's, which decides in float32: {differ} of {COUNT:,}\n")


def shapes(device: str, out: Callable[[str], None]) -> None:
    out(f"\n{COUNT // 4:,} points of other shapes\n")
    out("| shape | neighbors each | build ms | count ms | CSR ms | ns per found neighbor (count) | of uniform |")
    out("|---|---:|---:|---:|---:|---:|---:|")
    usual = 0.0
    for name, make in clouds.SHAPES.items():
        points, radius = make(COUNT // 4)
        given = wp.array(points, dtype=wp.vec3d, device=device)
        grid = NeighborGrid(given, radius, device=device)
        build = wall_median(lambda given=given, r=radius: NeighborGrid(given, r, device=device), RUNS)
        count = wall_median(lambda grid=grid: grid.count(), RUNS)
        lists = wall_median(lambda grid=grid: grid.radius_search(), RUNS)
        found = float(grid.count().numpy().mean())
        each = count / (len(points) * found) * 1e9
        usual = usual or each
        out(
            f"| {name} | {found:.1f} | {build * 1e3:.2f} | {count * 1e3:.2f} | {lists * 1e3:.2f} | {each:.4f} | "
            f"{each / usual:.2f} |"
        )
