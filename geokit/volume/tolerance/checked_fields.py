"""Builds fields that keep a tolerance: each field is checked at new points and rejected if it misses the tolerance."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.errors import DeviceMemoryError, InputError
from geokit.volume.tolerance.search import Search, Setting, quickest
from geokit.volume.tolerance.zone import Zone

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# Points at which a field is checked; then the WORST of them are moved MOVES times each, by the RADII [voxels].
CHECKED, WORST, MOVES = 120_000, 2_000, 9
RADII = (0.5, 0.25, 0.12, 0.06)
# Worst points of each round that are passed to the search after a failed check.
TOLD = 100
# First random seed of checks; the search does not use these seeds.
FIRST_SEED = 1_000_003
# Most fields that are built because a check found an error that the search had not seen.
TRIES = 10


class Achieved(NamedTuple):
    """Errors [world] at points that the search did not use.

    Attributes:
        largest: The largest error.
        p999: The 99.9th percentile.
        worst: Points with the largest errors [world], shape (N, 3).
    """

    largest: float
    p999: float
    worst: NDArray[np.float64]


class Made(NamedTuple):
    """A setting, its field, and the errors found by the check; the latter two are None if the field was too large."""

    setting: Setting
    volume: SparseVolume | None
    achieved: Achieved | None


def made_within(
    search: Search,
    make: Callable[[Setting], SparseVolume],
    *,
    most_leaves: float = math.inf,
    check: Callable[[SparseVolume, Setting, int], Achieved] | None = None,
) -> Made:
    """Build the field of least memory that keeps the tolerance at all checked points.

    Args:
        search: The search for settings.
        make: Builds the field of a setting.
        most_leaves: Fields that are predicted to have more leaves are not built, and their settings not checked.
        check: Returns the errors of a field at points that differ with the number given; None for checked_errors.
    Raises:
        InputError, DeviceMemoryError: The tolerance cannot be kept; the message says which one can.
    """
    best = math.inf
    for trial in range(TRIES):
        setting = next(quickest(search.settings()), None)
        if setting is None:
            break
        if setting.counts.leaves > most_leaves:
            return Made(setting, None, None)
        volume = make(setting)
        if check is None:
            achieved = checked_errors(search.zone, volume, setting, FIRST_SEED + trial)
        else:
            achieved = check(volume, setting, trial)
        if achieved.largest <= search.tolerance:
            return Made(setting, volume, achieved)
        best = min(best, achieved.largest)
        search.correct(setting, achieved.largest, achieved.worst)
    raise _refusal(search, best)


def checked_errors(zone: Zone, volume: SparseVolume, setting: Setting, seed: int) -> Achieved:
    """Errors of a field at new points of its zone, and at points around the worst of them."""
    points, exact = zone.draw(CHECKED, seed)
    errors = _errors(volume, points, exact, setting.option.order)
    largest = float(errors.max())
    p999 = float(np.quantile(errors, 0.999))
    found = []
    random = np.random.default_rng(seed)
    for radius in RADII:
        worst = np.argsort(errors)[-WORST:]
        around = np.repeat(points[worst], MOVES, axis=0)
        step = radius * setting.voxel_size
        near, near_exact = zone.near(zone.moved(around, step, random), step, random)
        points, exact = np.concatenate([points[worst], near]), np.concatenate([exact[worst], near_exact])
        errors = _errors(volume, points, exact, setting.option.order)
        largest = max(largest, float(errors.max()))
        found.append(points[np.argsort(errors)[-TOLD:]])
    return Achieved(largest, p999, np.concatenate(found))


def _refusal(search: Search, best: float) -> InputError | DeviceMemoryError:
    """The error to raise if no setting keeps the tolerance.

    Args:
        search: The search for settings.
        best: Least error [world] of the fields that were built.
    """
    reachable = search.reachable()
    if reachable <= search.tolerance or best < reachable:
        # The search's own estimate was built, and its check failed.
        reachable = best
    if not math.isfinite(reachable):
        return DeviceMemoryError(
            f"tolerance: not even a coarse band fits into {search.most_bytes / 2**20:.0f} MiB; free some memory"
        )
    text = f"tolerance: {search.tolerance:g} cannot be kept"
    if search.is_limited_by_memory and not search.is_stuck:
        needed = search.tolerance / reachable
        return DeviceMemoryError(
            f"{text} within {search.most_bytes / 2**20:.0f} MiB: about {reachable:.2g} can ({1 / needed:.3g} times as "
            "much); use that, more memory, another codec or order, or a smaller within"
        )
    return InputError(
        f"{text}: errors do not fall below about {reachable:.2g}, however small the voxels; use that or more, a wider "
        "half_width, or a smaller within (a sign that changes beside an open border is off by up to twice that)"
    )


def _errors(
    volume: SparseVolume, points: NDArray[np.float64], exact: NDArray[np.float64], order: int
) -> NDArray[np.float64]:
    device = next(iter(volume._uploads), "cpu")
    return np.asarray(np.abs(volume.sample(points, order=order, device=device) - exact))
