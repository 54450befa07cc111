"""Chart of rays on a level set, as stored and quantized, against a fine ray march through the float64 interpolant."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.volume_setup import SEED, coded, known_codecs
from geokit.accuracy.reference.volume import first_level
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, judged, on_host, send, setting_of, unit

if TYPE_CHECKING:
    from geokit.accuracy.charts.volume_setup import VolumePoints

# Farther than this many voxels beyond the leaves, a trilinear interpolant is the background.
MARGIN = 2.0
# The march misses a level that is touched, or crossed twice within a sixteenth of a cell. A hit before the first level
# of the march counts as right if the interpolant has the level there, up to this share of the range of values: some
# hundred times the roundings of a sum of eight float32 voxels in float64 at coordinates of 1e4 voxels.
ROUNDINGS = 1e-10


class _Rays(NamedTuple):
    """origins and directions (N, 3) [world], unit."""

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]


def volume_raycast_chart(field: VolumePoints) -> Chart:
    """Errors of the ray parameter of hits on a level set, by codec.

    Rays of unit direction start on a sphere around the volume and aim at random active voxels. The reference marches
    through the trilinear interpolant of the original values, in float64 NumPy, in steps of a sixteenth of a cell. A hit
    instead of a miss or a miss instead of a hit is wrong.
    """
    title = "First hit of a ray on a level set, as stored and in fewer bits"
    return Chart("volume_raycast", title, "world", "rays", lambda: _trials(field))


def _trials(field: VolumePoints) -> Iterator[Trial]:
    rays = _rays(field)
    checked = min(field.effort.checked_rays, len(rays.origins))
    wanted = _reference(field, rays, checked)
    origins, directions = send(rays.origins, field.device), send(rays.directions, field.device)
    for codec in known_codecs():
        parameters = {"codec": codec}
        try:
            grid = coded(field.volume, codec, field.value_range)
        except Exception as error:
            yield failed("volume.quantize", parameters, error)
            continue

        def judge(answer: Any) -> Judgement:
            return _judge(field, rays, on_host(answer.t)[:checked], wanted)

        def cast(grid: Any = grid) -> Any:
            return grid.raycast(origins, directions, isovalue=field.isovalue, device=field.device)

        setting, size = setting_of(parameters), grid.info.byte_count
        yield Trial("volume.raycast", setting, cast, judge, len(rays.origins), size, parameters)


def _rays(field: VolumePoints) -> _Rays:
    rng = np.random.default_rng(SEED + 5)
    count = field.effort.rays
    aims = field.points[rng.integers(len(field.points), size=count)]
    lower, upper = _box(field)
    corners = field.voxels.to_world(np.array([np.where(up, upper, lower) for up in np.ndindex(2, 2, 2)]))
    center = corners.mean(axis=0)
    start = center + 1.5 * np.linalg.norm(corners - center, axis=1).max() * unit(rng.normal(size=(count, 3)))
    return _Rays(start, unit(aims - start))


def _box(field: VolumePoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Index bounding box of the leaves around the active voxels; beyond it a level set is background."""
    bounds = field.volume.info.index_bounds
    assert bounds is not None  # a volume without active voxels has no charts
    return (bounds[0] & ~7) - MARGIN, (bounds[1] | 7) + MARGIN


def _reference(field: VolumePoints, rays: _Rays, count: int) -> NDArray[np.float64]:
    """Ray parameters (count,) of the first crossing of the level, inf for none."""
    lower, upper = _box(field)
    start = field.voxels.to_index(rays.origins[:count])
    toward = field.voxels.to_index(rays.origins[:count] + rays.directions[:count]) - start
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(lower - start) / toward, (upper - start) / toward])
    first, last = np.nanmax(ends.min(axis=0), axis=1), np.nanmin(ends.max(axis=0), axis=1)
    return np.array(
        [
            first_level(field.voxels, o, d, field.isovalue, max(a, 0.0), b) if max(a, 0.0) < b else np.inf
            for o, d, a, b in zip(start, toward, first, last, strict=True)
        ]
    )


def _judge(field: VolumePoints, rays: _Rays, t: NDArray[np.float64], wanted: NDArray[np.float64]) -> Judgement:
    origins, directions = rays.origins[: len(t)], rays.directions[: len(t)]
    hit, known = np.isfinite(t), np.isfinite(wanted)
    at = origins + np.where(hit, t, 0.0)[:, None] * directions
    off = np.abs(field.voxels.sample(at, 1) - field.isovalue)
    overlooked = hit & (t < wanted) & (off <= ROUNDINGS * field.value_range)
    both = hit & known
    errors = np.where(both & ~overlooked, np.abs(np.where(both, t, 0.0) - np.where(both, wanted, 0.0)), 0.0)
    shown = origins + np.where(known, wanted, np.where(hit, t, 0.0))[:, None] * directions
    return judged(errors, shown, (hit != known) & ~overlooked)
