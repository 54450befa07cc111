"""Charts of normals of points: against plane fits in float64, and against a known shape."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.points_setup import SEED
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import angles, judged, on_host, send, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.points_setup import PointsSetup

__all__ = ["point_normals_charts", "torus_cloud"]

Floats = NDArray[np.float64]

NEIGHBORS = (8, 16, 32, 64)
QUICK_NEIGHBORS = (8, 32)
ORIENTATIONS = ("none", "propagation")
# If the two least eigenvalues differ by less than this share of the largest, a neighborhood has no unique best plane,
# and rounding turns it.
GAP = 1e-3
# Radii of the torus, and the standard deviation of the noise along its normals: a tenth of a percent, like a scanner's.
MAJOR, MINOR, NOISE = 1.0, 0.4, 1e-3
# Points of the torus, in a quick chart and in a full one, on a CPU.
COUNTS = (5_000, 20_000)


def point_normals_charts(setup: PointsSetup) -> list[Chart]:
    """Angles between normals and planes through the same neighbors, and between normals and those of a noisy torus.

    The first chart shows the arithmetic error: neighborhoods without a unique best plane are left out, and signs do not
    count. The second shows the effect of the number of neighbors on the true error; normals that point inward are wrong
    if orientation was requested. It is the same for all subjects.
    """
    title = "Normals of points"
    return [
        Chart("point_normals", f"{title}, against planes", "degrees", "points", lambda: _against_planes(setup)),
        Chart("torus_normals", f"{title} of a noisy torus", "degrees", "points", lambda: _against_torus(setup)),
    ]


def torus_cloud(count: int, noise: float = NOISE) -> tuple[Floats, Floats]:
    """Random points (N, 3), uniform by area, of a torus around the z axis, and its normals there (N, 3).

    Args:
        count: Number of points.
        noise: Standard deviation of the displacement along the normals.
    """
    rng = np.random.default_rng(SEED + 2)
    across = rng.uniform(0.0, 2.0 * np.pi, 3 * count)
    # The area of a ring is proportional to its radius.
    kept = across[rng.uniform(0.0, MAJOR + MINOR, len(across)) < MAJOR + MINOR * np.cos(across)][:count]
    around = rng.uniform(0.0, 2.0 * np.pi, len(kept))
    normals = np.stack([np.cos(kept) * np.cos(around), np.cos(kept) * np.sin(around), np.sin(kept)], axis=1)
    middle = MAJOR * np.stack([np.cos(around), np.sin(around), np.zeros(len(kept))], axis=1)
    return middle + (MINOR + noise * rng.normal(size=(len(kept), 1))) * normals, normals


def _against_planes(setup: PointsSetup) -> Iterator[Trial]:
    cloud = setup.thinned
    points, rows = send(cloud, setup.device), setup.choose(len(cloud), len(cloud))
    wanted = [k for k in (QUICK_NEIGHBORS if setup.quick else NEIGHBORS) if k <= len(cloud)]
    near = cache(lambda: reference.k_nearest(cloud, max(wanted), cloud[rows])[1])
    for k in wanted:
        planes = cache(partial(_planes, cloud, near, k))

        if not (planes().gap > GAP).any():
            continue

        def judge(answer: Any, planes: Callable[[], reference.PlaneReference] = planes) -> Judgement:
            expected, gap = planes()
            counts = gap > GAP
            turn = angles(on_host(answer.normals)[rows], expected)
            return judged(np.minimum(turn, 180.0 - turn)[counts], cloud[rows][counts])

        yield _trial(points, k, ORIENTATIONS[0], setup.device, judge)


def _planes(points: Floats, near: Callable[[], Any], k: int) -> reference.PlaneReference:
    return reference.plane_normals(points, near()[:, :k])


def _against_torus(setup: PointsSetup) -> Iterator[Trial]:
    positions, wanted = torus_cloud(COUNTS[0 if setup.quick else 1] * (10 if str(setup.device) != "cpu" else 1))
    points = send(positions, setup.device)
    for k in QUICK_NEIGHBORS if setup.quick else NEIGHBORS:
        for orientation in ORIENTATIONS:

            def judge(answer: Any, either: bool = orientation == "none") -> Judgement:
                turn = angles(on_host(answer.normals), wanted)
                inward = turn > 90.0
                errors = np.where(inward, 180.0 - turn, turn) if either else turn
                return judged(errors, positions, None if either else inward)

            yield _trial(points, k, orientation, setup.device, judge)


def _trial(points: Any, k: int, orientation: str, device: Any, judge: Callable[[Any], Judgement]) -> Trial:
    from geokit.points._normals import normals

    chosen = {"k": k, "orientation": orientation}
    run = partial(normals, points, k=k, orientation=orientation, device=device)
    return Trial(f"normals, {orientation}", setting_of(chosen), run, judge, len(points), 0, chosen)
