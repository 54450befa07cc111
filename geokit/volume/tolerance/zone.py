"""Where a field that is made within a tolerance has to be right, and what is right there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geokit.core import user_arrays
from geokit.errors import InputError

__all__ = ["Zone", "checked_within"]

# Share of the tolerance that a field of an open mesh keeps it within: beside its border the sign jumps, and the field
# is off by twice the distance there.
OPEN_SHARE = 0.25

# Draws before what was found is taken: of a shell little of a draw may lie in the zone.
DRAWS = 8


@dataclass(frozen=True)
class Zone:
    """All points that are no farther than ``within`` from the surface of the field.

    Attributes:
        truth: The exact field at points (N, 3) [world], float64.
        seeds: Gives so many points of the mesh's surface from a seed of random numbers.
        bounds: Box around the mesh [world], shape (2, 3).
        within: How far from the field's surface the promise holds [world].
        offset: Distance [world] of the field's surface from the mesh: half the thickness of a shell, else 0.
    """

    truth: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    seeds: Callable[[int, int], NDArray[np.float64]]
    bounds: NDArray[np.float64]
    within: float
    offset: float

    @property
    def longest(self) -> float:
        """Longest side of the box around the field's surface [world]."""
        return float((self.bounds[1] - self.bounds[0]).max()) + 2.0 * self.offset

    def draw(self, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """About so many points of the zone, uniform along the surface, and the field there.

        The same for the same seed. Of a shell only the points that land in its zone are left.
        """
        random = np.random.default_rng(seed)
        found = []
        for draw in range(DRAWS):
            points = self.moved(self.seeds(count, seed + draw), self.within, random, self.offset)
            found.append(self.kept(points))
            if sum(len(points) for points, _ in found) >= count:
                break
        points, exact = (np.concatenate(arrays)[:count] for arrays in zip(*found, strict=True))
        return points, exact

    def moved(
        self, points: NDArray[np.float64], most: float, random: np.random.Generator, least: float = 0.0
    ) -> NDArray[np.float64]:
        """Points, each moved in a random direction by ``least`` and up to ``most`` more [world]."""
        directions = random.normal(size=points.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        moved = points + directions * (least + most * random.uniform(size=(len(points), 1)))
        return np.asarray(moved)

    def kept(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Those of the points that lie in the zone, and the field there."""
        exact = self.truth(points)
        inside = np.abs(exact) <= self.within
        return points[inside], exact[inside]


def checked_within(within: float | None, tolerance: float, *, jumps: bool) -> float:
    """How far from the surface a tolerance holds [world].

    Args:
        within: What was asked for; None for the default.
        tolerance: Largest error [world].
        jumps: The field is signed and its mesh is open.
    Raises:
        InputError: It is no number, not finite, or negative.
    """
    if within is None:
        return OPEN_SHARE * tolerance if jumps else tolerance
    within = user_arrays.require_finite_scalar(within, "within")
    if within < 0.0:
        raise InputError(f"within: {within} is negative; use 0 or more")
    return within
