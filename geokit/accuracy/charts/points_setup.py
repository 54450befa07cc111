"""What the charts of points share: queries, which of them are checked, and how many there are."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointsSetup"]

Floats = NDArray[np.float64]

# Seed of every random choice: charts of two runs ask the same.
SEED = 29
# Queries of a timed call, in a quick chart and else: 1 to 50 ms, and up to 300 ms, on two cores; more for a GPU, which
# would only be launched otherwise.
COUNTS = {"cpu": (10_000, 100_000), "cuda": (100_000, 500_000)}
# Points of methods that answer for all of them; of larger clouds that many are drawn.
LARGEST = {"cpu": (20_000, 100_000), "cuda": (200_000, 1_000_000)}
# Pairs of a query and a point that the references of a chart may look at; each takes 5 ns.
QUICK_PAIRS = 10_000_000
PAIRS = 100_000_000
# At least and at most so many answers are checked.
LEAST, MOST = 64, 2000


class PointsSetup:
    """Points on a device, with queries; made when first asked for.

    Args:
        points: Positions [world], shape (N, 3).
        device: Where the methods run.
        quick: Whether to ask little.
    """

    def __init__(self, points: Floats, device: Any, quick: bool) -> None:
        self.points, self.device, self.quick = np.asarray(points, np.float64), device, quick
        kind = "cuda" if str(device).startswith("cuda") else "cpu"
        self.count, self.largest = (counts[kind][0 if quick else 1] for counts in (COUNTS, LARGEST))

    @cached_property
    def thinned(self) -> Floats:
        """The points, or so many of them that a method that answers for each takes no longer than others."""
        if len(self.points) <= self.largest:
            return self.points
        chosen = np.random.default_rng(SEED + 3).choice(len(self.points), self.largest, replace=False)
        return self.points[np.sort(chosen)]

    @cached_property
    def radius(self) -> float:
        """The radius [world] that a NeighborGrid chooses by itself, in three digits."""
        from geokit.points._neighbors import NeighborGrid

        return float(f"{NeighborGrid(self.points, device=self.device).radius:.3g}")

    @cached_property
    def queries(self) -> Floats:
        """Points [world] of the cloud, each moved by up to half the radius."""
        rng = np.random.default_rng(SEED)
        chosen = self.points[rng.integers(len(self.points), size=self.count)]
        return chosen + rng.uniform(-0.5, 0.5, chosen.shape) * self.radius

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Rows of the queries that are checked, ascending."""
        return self.choose(self.count)

    @property
    def checked(self) -> Floats:
        """Those queries."""
        return self.queries[self.rows]

    def choose(self, count: int, width: int = 0) -> NDArray[np.int64]:
        """Some of ``count`` rows, ascending, whose references look at ``width`` points each; 0 for all of the cloud."""
        pairs = (QUICK_PAIRS if self.quick else PAIRS) // (width or len(self.points))
        some = min(max(pairs, LEAST), MOST, count)
        return np.sort(np.random.default_rng(SEED + 1).choice(count, some, replace=False))
