"""Prediction of the settings and the cost of a distance field with a tolerance, before it is made."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple

from geokit.volume.tolerance.checked_fields import made_within
from geokit.volume.tolerance.from_mesh import make_setting, tolerance_search
from geokit.volume.tolerance.search import Search, Setting, quickest

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh
    from geokit.mesh._surface import Surface

__all__ = ["PlannedField", "plan"]

# Leaves of the small band that is built to measure the time.
TIMED_LEAVES = 2000.0
# A field of at most this many leaves is built and checked, as in from_mesh: that takes a second or two.
CHECKED_LEAVES = 20_000.0


class PlannedField(NamedTuple):
    """A setting of :func:`geokit.volume.from_mesh` that keeps a tolerance, with its predicted cost.

    Attributes:
        order: Order of interpolation, 1, 2 or 3.
        codec: Codec of the values.
        voxel_size: Edge length of a voxel [world].
        half_width: Width of the band on either side of the surface [voxels].
        error: Predicted largest error of the interpolated distance [world].
        byte_count: Predicted size of the grid in bytes.
        seconds: Predicted time to build it [s], without the search.
    """

    order: int
    codec: str
    voxel_size: float
    half_width: float
    error: float
    byte_count: int
    seconds: float


def plan(
    mesh: TriangleMesh | Surface,
    tolerance: float,
    *,
    within: float | None = None,
    order: int | None = None,
    half_width: float | None = None,
    sign: str = "auto",
    thickness: float | None = None,
    codec: str | None = None,
    device: Any = None,
) -> list[PlannedField]:
    """List settings with which a mesh's distance field keeps a tolerance; ``from_mesh`` tries the first one first.

    There is one setting for each order and codec that can compete; all others need more memory than the best, whatever
    their other settings. No error is above the tolerance. If the first setting has no more than 20,000 leaves, it is
    built and checked. Otherwise it is predicted like the others, and a check may still lead ``from_mesh`` to another
    one near it. The memory is that of the grid to a quarter. The time is extrapolated from a small band of the same
    mesh by the number of leaves.

    Args:
        mesh: Triangles, or a Surface of them.
        tolerance: Largest error of the interpolated distance [world].
        within: Distance from the surface up to which the tolerance holds [world]; None as for :func:`from_mesh`.
        order: Order of interpolation; None for all.
        half_width: Width of the band [voxels]; None for as little as interpolation needs.
        sign: Method that tells inside from outside, as for :func:`from_mesh`.
        thickness: Thickness [world] of a solid shell around the surface.
        codec: Codec of the values; None for all.
        device: Where to compute.
    Returns:
        The settings, least memory first; of equal memory (to 5 %) the fastest to read.
    Raises:
        InputError: An argument is out of range, or no setting keeps the tolerance; the message names one that can be
            kept.
        DeviceMemoryError: No setting that keeps the tolerance fits into memory.
    Example:
        >>> torus = gk.mesh.load("data/samples/torus.ply")
        >>> best = gk.volume.plan(torus, 0.01, device="cpu")[0]
        >>> best.error <= 0.01, best.byte_count < 1_000_000
        (True, True)

    Held by: tests/volume/tolerance/test_from_mesh.py
    """
    search = tolerance_search(
        mesh,
        tolerance,
        within=within,
        order=order,
        half_width=half_width,
        sign=sign,
        thickness=thickness,
        codec=codec,
        device=device,
    )
    made = made_within(search, lambda s: make_setting(search, s), most_leaves=CHECKED_LEAVES)
    settings = _best_of_each(search)
    if made.achieved is not None:
        settings[0] = made.setting._replace(error=made.achieved.largest)
    per_leaf: dict[str, float] = {}
    planned = []
    for setting in settings:
        kind = setting.option.codec
        if kind not in per_leaf:
            per_leaf[kind] = _seconds_per_leaf(search, setting)
        planned.append(
            PlannedField(
                setting.option.order,
                kind,
                setting.voxel_size,
                setting.half_width,
                setting.error,
                round(setting.byte_count),
                per_leaf[kind] * setting.counts.leaves,
            )
        )
    return planned


def _best_of_each(search: Search) -> list[Setting]:
    """The best of each group of settings that differ only in the codec's share of the tolerance."""
    found: dict[tuple[int, str], Setting] = {}
    for setting in quickest(search.settings()):
        found.setdefault((setting.option.order, setting.option.codec), setting)
    return list(found.values())


def _seconds_per_leaf(search: Search, setting: Setting) -> float:
    """Time per leaf of a band like this one, measured on a small one; the first call also loads the kernels."""
    coarser = max(1.0, setting.counts.leaves / TIMED_LEAVES) ** 0.5
    small = setting._replace(voxel_size=setting.voxel_size * coarser)
    for _ in range(2):
        start = time.perf_counter()
        volume = make_setting(search, small)
        seconds = time.perf_counter() - start
    leaves = search.memory.counts(small.voxel_size, small.half_width * small.voxel_size).leaves
    return seconds / leaves if volume.info.active_voxel_count else 0.0
