"""Charts of point clouds: neighbors within a radius, the k nearest, normals, and downsampling."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import angles, held_bytes, judged, on_host, send, setting_of
from geokit.core.base.late_warp import wp
from geokit.points.neighbors.neighbor_grid import NeighborGrid

Floats = NDArray[np.float64]

# Seed of every random choice: two runs use the same queries.
SEED = 29
# Queries of a timed call, in a quick chart and in a full one: 1 to 50 ms, and up to 300 ms, on two cores; more on a
# GPU, where launch overhead would dominate otherwise.
COUNTS = {"cpu": (10_000, 100_000), "cuda": (100_000, 500_000)}
# Number of points for methods that process every point; larger clouds are subsampled to it.
LARGEST = {"cpu": (20_000, 100_000), "cuda": (200_000, 1_000_000)}
# Budget of pairs of a query and a point for the references of a chart; a pair takes 5 ns.
QUICK_PAIRS = 10_000_000
PAIRS = 100_000_000
# Least and greatest number of checked answers.
LEAST, MOST = 64, 2000
# Radii that cells are made for, in units of the search radius. Up to 2 the cells are used as they are; beyond, the
# first call sorts the points again.
CELLS = (0.5, 1.0, 2.0, 4.0)
QUICK_CELLS = (0.5, 1.0, 2.0)
ORDERS = ("any", "index", "distance")
NEAREST = (1, 8, 32)
# Share of a NeighborGrid's default radius: so short that some rows of k are not filled.
HYBRID = 0.25
# Memory of a warp HashGrid: 16 MiB plus 20 bytes a point, from docs/kernels.md.
HASH_GRID, HASH_POINT = 16 << 20, 20
NEIGHBORS = (8, 16, 32, 64)
QUICK_NEIGHBORS = (8, 32)
ORIENTATIONS = ("none", "propagation")
# If the two least eigenvalues differ by less than this share of the largest, a neighborhood has no unique best plane,
# and rounding turns it.
GAP = 1e-3
# Radii of the torus, and the standard deviation of the noise along its normals: a tenth of a percent, like a scanner's.
MAJOR, MINOR, NOISE = 1.0, 0.4, 1e-3
# Points of the torus, in a quick chart and in a full one, on a CPU.
TORUS_COUNTS = (5_000, 20_000)
# Distances between kept points, in units of a NeighborGrid's default radius.
STEPS = (1.0, 2.0, 4.0)
QUICK_STEPS = (2.0, 4.0)


class PointsSetup:
    """Points on a device, with queries; attributes are computed on first access.

    Args:
        points: Positions [world], shape (N, 3).
        device: Where the methods run.
        quick: Use fewer queries.
    """

    def __init__(self, points: Floats, device: Any, quick: bool) -> None:
        self.points, self.device, self.quick = np.asarray(points, np.float64), device, quick
        kind = "cuda" if str(device).startswith("cuda") else "cpu"
        self.count, self.largest = (counts[kind][0 if quick else 1] for counts in (COUNTS, LARGEST))

    @cached_property
    def thinned(self) -> Floats:
        """The points, or a random subset, so that methods that process every point take no longer than others."""
        if len(self.points) <= self.largest:
            return self.points
        chosen = np.random.default_rng(SEED + 3).choice(len(self.points), self.largest, replace=False)
        return self.points[np.sort(chosen)]

    @cached_property
    def radius(self) -> float:
        """Default radius of a NeighborGrid over the points [world], rounded to three digits."""
        return float(f"{NeighborGrid(self.points, device=self.device).radius:.3g}")

    @cached_property
    def queries(self) -> Floats:
        """Points [world] of the cloud, each displaced by up to half the radius."""
        rng = np.random.default_rng(SEED)
        chosen = self.points[rng.integers(len(self.points), size=self.count)]
        return chosen + rng.uniform(-0.5, 0.5, chosen.shape) * self.radius

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the checked queries, ascending."""
        return self.choose(self.count)

    @property
    def checked(self) -> Floats:
        """The checked queries."""
        return self.queries[self.rows]

    def choose(self, count: int, width: int = 0) -> NDArray[np.int64]:
        """Random rows of ``count``, ascending, whose references look at ``width`` points each; 0 for the whole
        cloud."""
        pairs = (QUICK_PAIRS if self.quick else PAIRS) // (width or len(self.points))
        some = min(max(pairs, LEAST), MOST, count)
        return np.sort(np.random.default_rng(SEED + 1).choice(count, some, replace=False))


def neighbors_chart(setup: PointsSetup) -> Chart:
    """Shares of queries with a wrong set of neighbors, by cell size, order and precision.

    A count is wrong if it differs from the reference. The error of a radius search is that of its distances.
    """
    title = "Neighbors within a radius"
    return Chart("neighbors", title, "world", "queries", lambda: _radius_trials(setup), "wrong")


def nearest_chart(setup: PointsSetup) -> Chart:
    """Errors of distances to the k nearest points; indices that differ from the reference are wrong."""
    return Chart("nearest", "The nearest k points", "world", "queries", lambda: _nearest_trials(setup))


def _radius_trials(setup: PointsSetup) -> Iterator[Trial]:
    from geokit.accuracy.charts.raw_queries import raw_radius_count

    queries, radius = send(setup.queries, setup.device), setup.radius
    single = wp.array(setup.queries.astype(np.float32), dtype=wp.vec3f, device=setup.device)
    known = cache(partial(_within, setup))
    judge, judge_counts = partial(_judge_lists, setup, known), partial(_judge_counts, setup, known)

    def trial(method: str, run: Callable[[], Any], judge: Any, size: int, **chosen: Any) -> Trial:
        return Trial(method, setting_of(chosen), run, judge, setup.count, size, chosen)

    for ratio in QUICK_CELLS if setup.quick else CELLS:
        grid = NeighborGrid(setup.points, ratio * radius, device=setup.device)
        size, cells = held_bytes(grid), {"radius": radius, "cell_size": ratio * radius}
        yield trial("count, float64", partial(grid.count, queries, radius=radius), judge_counts, size, **cells)
        for order in ORDERS if ratio == 1.0 else ORDERS[:1]:
            run = partial(grid.radius_search, queries, radius=radius, order=order)
            yield trial("radius_search, float64", run, judge, size, **cells, order=order)
    grid = NeighborGrid(setup.points, radius, device=setup.device)
    cells = {"radius": radius, "cell_size": radius}
    counting = partial(grid.count, single, radius=radius)
    yield trial("count, float32", counting, judge_counts, held_bytes(grid), **cells)
    run = partial(grid.radius_search, single, radius=radius, order="any")
    yield trial("radius_search, float32", run, judge, held_bytes(grid), **cells, order="any")

    def made_and_asked() -> Any:
        return NeighborGrid(setup.points, radius, device=setup.device).count(queries)

    yield trial("NeighborGrid made and asked to count", made_and_asked, judge_counts, 0, **cells)
    points = wp.array(setup.points.astype(np.float32), dtype=wp.vec3f, device=setup.device)
    size = HASH_GRID + HASH_POINT * len(setup.points)
    run = partial(raw_radius_count, grid, points, single, radius)
    yield trial("warp.hash_grid_query count, float32", run, judge_counts, size, **cells)


def _nearest_trials(setup: PointsSetup) -> Iterator[Trial]:
    grid = NeighborGrid(setup.points, setup.radius, device=setup.device)
    grid.knn(setup.queries[:1])  # builds the tree
    queries = send(setup.queries, setup.device)
    single = wp.array(setup.queries.astype(np.float32), dtype=wp.vec3f, device=setup.device)
    known = cache(lambda: reference.k_nearest(setup.points, max(NEAREST), setup.checked))

    def trial(method: str, run: Callable[[], Any], k: int, **more: Any) -> Trial:
        chosen = {"k": k, **more}
        reach = more.get("radius", np.inf)
        judge = partial(_judge_nearest, setup, known, k, reach)
        return Trial(method, setting_of(chosen), run, judge, setup.count, held_bytes(grid), chosen)

    for k in NEAREST:
        yield trial("knn, float64", partial(grid.knn, queries, k), k)
    k, radius = NEAREST[1], float(f"{HYBRID * setup.radius:.3g}")
    yield trial("knn, float32", partial(grid.knn, single, k), k)
    yield trial("hybrid, float64", partial(grid.hybrid, queries, k, radius=radius), k, radius=radius)

    def made_and_asked() -> Any:
        return NeighborGrid(setup.points, device=setup.device).knn(queries, k)

    yield trial("NeighborGrid made and asked for knn", made_and_asked, k)


def _within(setup: PointsSetup) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Neighbors of the checked queries by ascending index, and their distances."""
    found = reference.neighbors_within(setup.points, setup.checked, setup.radius)
    at = setup.checked
    return [(near, np.linalg.norm(setup.points[near] - at[i], axis=1)) for i, near in enumerate(found)]


def _judge_counts(setup: PointsSetup, known: Callable[[], Any], answer: Any) -> Judgement:
    wrong = on_host(answer)[setup.rows] != [len(near) for near, _ in known()]
    return judged(np.zeros(len(wrong)), setup.checked, wrong)


def _judge_lists(setup: PointsSetup, known: Callable[[], Any], answer: Any) -> Judgement:
    offsets, indices, distance = (part.numpy() for part in answer)
    errors, wrong = np.zeros(len(setup.rows)), np.zeros(len(setup.rows), bool)
    for i, (row, (near, apart)) in enumerate(zip(setup.rows, known(), strict=True)):
        found = slice(offsets[row], offsets[row + 1])
        order = np.argsort(indices[found])
        wrong[i] = not np.array_equal(indices[found][order], near)
        if not wrong[i] and len(near):
            errors[i] = np.abs(distance[found][order].astype(np.float64) - apart).max()
    return judged(errors, setup.checked, wrong)


def _judge_nearest(setup: PointsSetup, known: Callable[[], Any], k: int, reach: float, answer: Any) -> Judgement:
    apart, near = (part[:, :k] for part in known())
    beyond = apart > reach
    apart, near = np.where(beyond, np.inf, apart), np.where(beyond, -1, near)
    distance, indices = on_host(answer.distance)[setup.rows], on_host(answer.indices)[setup.rows]
    wrong = (indices != near).any(axis=1)
    same = np.isinf(apart) & np.isinf(distance)
    errors = np.abs(np.where(same, 0.0, distance) - np.where(same, 0.0, apart)).max(axis=1)
    return judged(errors, setup.checked, wrong)


def point_normals_charts(setup: PointsSetup) -> list[Chart]:
    """Angles between normals and planes through the same neighbors, and between normals and those of a noisy torus.

    The first chart shows the arithmetic error: neighborhoods without a unique best plane are left out, and signs do not
    count. The second shows the effect of the number of neighbors on the true error; normals that point inward are wrong
    if orientation was requested. It is the same for all subjects.
    """
    title = "Normals of points"
    return [
        Chart("point_normals", f"{title}, against planes", "degrees", "points", lambda: _against_planes(setup)),
        Chart("torus_normals", f"{title} of a noisy torus", "degrees", "points", lambda: _against_torus(setup)),
    ]


def torus_cloud(count: int, noise: float = NOISE) -> tuple[Floats, Floats]:
    """Random points (N, 3), uniform by area, of a torus around the z axis, and its normals there (N, 3).

    Args:
        count: Number of points.
        noise: Standard deviation of the displacement along the normals.
    """
    rng = np.random.default_rng(SEED + 2)
    across = rng.uniform(0.0, 2.0 * np.pi, 3 * count)
    # The area of a ring is proportional to its radius.
    kept = across[rng.uniform(0.0, MAJOR + MINOR, len(across)) < MAJOR + MINOR * np.cos(across)][:count]
    around = rng.uniform(0.0, 2.0 * np.pi, len(kept))
    normals = np.stack([np.cos(kept) * np.cos(around), np.cos(kept) * np.sin(around), np.sin(kept)], axis=1)
    middle = MAJOR * np.stack([np.cos(around), np.sin(around), np.zeros(len(kept))], axis=1)
    return middle + (MINOR + noise * rng.normal(size=(len(kept), 1))) * normals, normals


def _against_planes(setup: PointsSetup) -> Iterator[Trial]:
    cloud = setup.thinned
    points, rows = send(cloud, setup.device), setup.choose(len(cloud), len(cloud))
    wanted = [k for k in (QUICK_NEIGHBORS if setup.quick else NEIGHBORS) if k <= len(cloud)]
    near = cache(lambda: reference.k_nearest(cloud, max(wanted), cloud[rows])[1])
    for k in wanted:
        planes = cache(partial(_planes, cloud, near, k))

        if not (planes().gap > GAP).any():
            continue

        def judge(answer: Any, planes: Callable[[], reference.PlaneReference] = planes) -> Judgement:
            expected, gap = planes()
            counts = gap > GAP
            turn = angles(on_host(answer.normals)[rows], expected)
            return judged(np.minimum(turn, 180.0 - turn)[counts], cloud[rows][counts])

        yield _normals_trial(points, k, ORIENTATIONS[0], setup.device, judge)


def _planes(points: Floats, near: Callable[[], Any], k: int) -> reference.PlaneReference:
    return reference.plane_normals(points, near()[:, :k])


def _against_torus(setup: PointsSetup) -> Iterator[Trial]:
    positions, wanted = torus_cloud(TORUS_COUNTS[0 if setup.quick else 1] * (10 if str(setup.device) != "cpu" else 1))
    points = send(positions, setup.device)
    for k in QUICK_NEIGHBORS if setup.quick else NEIGHBORS:
        for orientation in ORIENTATIONS:

            def judge(answer: Any, either: bool = orientation == "none") -> Judgement:
                turn = angles(on_host(answer.normals), wanted)
                inward = turn > 90.0
                errors = np.where(inward, 180.0 - turn, turn) if either else turn
                return judged(errors, positions, None if either else inward)

            yield _normals_trial(points, k, orientation, setup.device, judge)


def _normals_trial(points: Any, k: int, orientation: str, device: Any, judge: Callable[[Any], Judgement]) -> Trial:
    from geokit.points._normals import normals

    chosen = {"k": k, "orientation": orientation}
    run = partial(normals, points, k=k, orientation=orientation, device=device)
    return Trial(f"normals, {orientation}", setting_of(chosen), run, judge, len(points), 0, chosen)


def downsample_chart(setup: PointsSetup) -> Chart:
    """Distances from the points of the cloud to the nearest kept point, by method, at comparable numbers kept.

    For each step the cloud, or a random part of a large one, is reduced by Poisson disks of that radius, to voxels of
    that size, and to as many farthest points as there are Poisson disks; ``kept`` is the number of points kept.
    """
    title = "Distance from the points to the ones that are left"
    return Chart("downsample", title, "world", "points", lambda: _downsample_trials(setup))


def _downsample_trials(setup: PointsSetup) -> Iterator[Trial]:
    from geokit.points._downsample import downsample

    points = send(setup.thinned, setup.device)
    for step in QUICK_STEPS if setup.quick else STEPS:
        length = float(f"{step * setup.radius:.3g}")
        kept = len(downsample(points, radius=length, device=setup.device).indices)
        for name, value in (("radius", length), ("voxel_size", length), ("count", kept)):
            size: dict[str, Any] = {name: value}
            run = partial(downsample, points, device=setup.device, **size)
            chosen = {name: value, "kept": kept if name != "voxel_size" else len(run().indices)}
            yield Trial(
                f"downsample, {name}",
                setting_of(chosen),
                run,
                partial(_judge_kept, setup),
                len(setup.thinned),
                0,
                chosen,
            )


def _judge_kept(setup: PointsSetup, answer: Any) -> Judgement:
    kept = on_host(answer.points)
    at = setup.thinned[setup.choose(len(setup.thinned), len(kept))]
    return judged(reference.k_nearest(kept, 1, at)[0][:, 0], at)
