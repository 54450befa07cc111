"""Shared setup of the charts of points: queries, and the rows that are checked."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointsSetup"]

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
        from geokit.points.neighbors.neighbor_grid import NeighborGrid

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
