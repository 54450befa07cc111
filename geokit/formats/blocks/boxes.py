"""A k-d tree that divides points into boxes with about equally many in each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Points of a sample that place the last cuts.
FEWEST = 8


class Boxes:
    """Boxes around shares of a sample, cut at medians across the longest side.

    Args:
        sample: Points (S, 3), at least one.
        count: Number of boxes that is wanted; the next power of two is made, if the sample has enough points.
    """

    def __init__(self, sample: NDArray[np.float64], count: int) -> None:
        wanted = min(count, max(len(sample) // FEWEST, 1))
        self._depth = max(wanted - 1, 0).bit_length()
        self._axis = np.zeros((1 << self._depth) - 1, np.int64)
        self._cut = np.zeros((1 << self._depth) - 1)
        # By axis: NumPy takes extremes of long rows ten times as fast as of short ones.
        nodes = [np.ascontiguousarray(sample.T)]
        for node in range(len(self._cut)):
            points = nodes[node]
            if not points.size:
                # A box without points is divided by no point.
                nodes += [points, points]
                continue
            axis = int(np.argmax(points.max(axis=1) - points.min(axis=1)))
            values = points[axis]
            cut = np.partition(values, len(values) // 2)[len(values) // 2]
            # Equal values lie above a cut. Where half of all are the least one, the cut must lie above that.
            if cut == values.min() and cut < values.max():
                cut = values[values > cut].min()
            self._axis[node], self._cut[node] = axis, cut
            above = values >= cut
            nodes += [points[:, ~above], points[:, above]]
            nodes[node] = points[:, :0]

    @property
    def count(self) -> int:
        """Number of boxes."""
        return len(self._cut) + 1

    def of(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Number of the box of each point (N, 3); each point of space lies in one."""
        node = np.zeros(len(points), np.int64)
        flat = np.ascontiguousarray(points).reshape(-1)
        first = 3 * np.arange(len(points))
        for _ in range(self._depth):
            node = 2 * node + 1 + (flat[first + self._axis[node]] >= self._cut[node])
        return node - len(self._cut)
