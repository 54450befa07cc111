"""Charts of neighbor searches: within a radius, by cell size and order of the rows, and the k nearest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import held_bytes, judged, on_host, send, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.points_setup import PointsSetup

__all__ = ["nearest_chart", "neighbors_chart"]

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
    import warp as wp

    from geokit.accuracy.charts.raw_queries import raw_radius_count
    from geokit.points.neighbors.neighbor_grid import NeighborGrid

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
    import warp as wp

    from geokit.points.neighbors.neighbor_grid import NeighborGrid

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
