"""Chart of downsampling: the distance from the points left out to the points kept."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import judged, on_host, send, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.points_setup import PointsSetup

__all__ = ["downsample_chart"]

# Distances between kept points, in units of a NeighborGrid's default radius.
STEPS = (1.0, 2.0, 4.0)
QUICK_STEPS = (2.0, 4.0)


def downsample_chart(setup: PointsSetup) -> Chart:
    """Distances from the points of the cloud to the nearest kept point, by method, at comparable numbers kept.

    For each step the cloud, or a random part of a large one, is reduced by Poisson disks of that radius, to voxels of
    that size, and to as many farthest points as there are Poisson disks; ``kept`` is the number of points kept.
    """
    title = "Distance from the points to the ones that are left"
    return Chart("downsample", title, "world", "points", lambda: _trials(setup))


def _trials(setup: PointsSetup) -> Iterator[Trial]:
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
                f"downsample, {name}", setting_of(chosen), run, partial(_judge, setup), len(setup.thinned), 0, chosen
            )


def _judge(setup: PointsSetup, answer: Any) -> Judgement:
    kept = on_host(answer.points)
    at = setup.thinned[setup.choose(len(setup.thinned), len(kept))]
    return judged(reference.k_nearest(kept, 1, at)[0][:, 0], at)
