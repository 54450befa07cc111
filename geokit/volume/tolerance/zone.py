"""The zone in which a field must keep a tolerance, and the exact field there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop import user_arrays
from geokit.errors import InputError

# Width of the zone of an open mesh, as a share of the tolerance. Beside the mesh's border the sign jumps, and the field
# is off by twice the distance there.
OPEN_SHARE = 0.25

# Sizes of fields [world] between which voxels and distances are normal float32 numbers, with 6 digits to spare.
SHORTEST, LONGEST = 1e-32, 1e32

# Most draws of points; for a shell, only a small part of a draw may lie in the zone.
DRAWS = 8
# A zone is thin if it is less than this share of how far points are moved, or if it holds less than FEW of them.
THIN, FEW = 0.005, 0.02
# Rounding of a distance, as a share of the largest coordinate: some 64 units in the last place.
ROUNDING = 1.5e-14


@dataclass(frozen=True)
class Zone:
    """All points no farther than ``within`` from the field's surface.

    Attributes:
        truth: The exact field at points (N, 3) [world], float64.
        seeds: Returns random points on the mesh's surface, from their number and a random seed.
        onto: Returns the nearest point of the field's surface for each of some points (N, 3) [world].
        bounds: Box around the mesh [world], shape (2, 3).
        within: Distance [world] from the field's surface up to which the tolerance holds.
        offset: Distance [world] of the field's surface from the mesh: half the thickness of a shell, else 0.
    """

    truth: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    seeds: Callable[[int, int], NDArray[np.float64]]
    onto: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    bounds: NDArray[np.float64]
    within: float
    offset: float

    @property
    def longest(self) -> float:
        """Longest side of the box around the field's surface [world]."""
        return float((self.bounds[1] - self.bounds[0]).max()) + 2.0 * self.offset

    def draw(self, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """About ``count`` points of the zone, uniform along the surface, and the field there.

        The same seed gives the same points. For a shell only the points that land in its zone are kept.
        """
        random = np.random.default_rng(seed)
        found = []
        for draw in range(DRAWS):
            points = self.moved(self.seeds(count, seed + draw), self.within, random, self.offset)
            found.append(self.near(points, self.offset, random))
            if sum(len(points) for points, _ in found) >= count:
                break
        points, exact = (np.concatenate(arrays)[:count] for arrays in zip(*found, strict=True))
        return points, exact

    def moved(
        self, points: NDArray[np.float64], most: float, random: np.random.Generator, least: float = 0.0
    ) -> NDArray[np.float64]:
        """Points, each moved in a random direction by ``least`` to ``least + most`` [world]."""
        directions = random.normal(size=points.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        moved = points + directions * (least + most * random.uniform(size=(len(points), 1)))
        return np.asarray(moved)

    def kept(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The points that lie in the zone, and the field there."""
        exact = self.truth(points)
        inside = self._holds(exact)
        return points[inside], exact[inside]

    def near(
        self, points: NDArray[np.float64], moved_by: float, random: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As :meth:`kept`, of points that were moved so far [world]; to a thin zone they are brought back."""
        exact = self.truth(points)
        inside = self._holds(exact)
        if (self.within >= THIN * moved_by and inside.sum() >= FEW * len(points)) or inside.all():
            return points[inside], exact[inside]
        back, back_exact = self.kept(self.moved(self.onto(points[~inside]), self.within, random))
        return np.concatenate([points[inside], back]), np.concatenate([exact[inside], back_exact])

    def _holds(self, exact: NDArray[np.float64]) -> NDArray[np.bool_]:
        # Points on the surface are off it by the rounding of their coordinates.
        return np.asarray(np.abs(exact) <= self.within + rounding_of(self.bounds, self.offset))


def rounding_of(bounds: NDArray[np.float64], offset: float = 0.0) -> float:
    """By how much the distance of a point on the surface may not be 0 [world].

    Args:
        bounds: Box around the mesh [world], shape (2, 3).
        offset: Distance [world] of the field's surface from the mesh.
    """
    return ROUNDING * (float(np.abs(bounds).max()) + offset)


def require_extent(longest: float) -> None:
    """Refuse fields whose voxels and distances would not be normal float32 numbers.

    Args:
        longest: Longest side of the box around the field's surface [world].
    Raises:
        InputError: It is too long, or zero.
    """
    if not SHORTEST < longest < LONGEST:
        raise InputError(
            f"mesh: the field's surface is {longest:.3g} across, which float32 does not divide into voxels; scale the "
            "mesh, or use another thickness"
        )


def checked_within(within: float | None, tolerance: float, *, jumps: bool) -> float:
    """Check ``within``, the distance [world] from the surface up to which a tolerance holds, or return its default.

    Args:
        within: The caller's value; None for the default.
        tolerance: Largest error [world].
        jumps: The field is signed and its mesh is open.
    Raises:
        InputError: ``within`` is not a number, not finite, or negative.
    """
    if within is None:
        return OPEN_SHARE * tolerance if jumps else tolerance
    return user_arrays.require_finite_scalar(within, "within", low=user_arrays.FROM_ZERO)
