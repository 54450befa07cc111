"""Charts of points: time and error of neighbor searches, normals and downsampling.

Every answer is compared with an independent reference (geokit/accuracy/reference): float64 NumPy that shares no code
with the method, on a random subset with a fixed seed. The reference of a chart is computed once. Points are on the
device before timing starts, and answers stay there. Tested in tests/accuracy/charts/test_points_charts.py, which also
makes methods worse on purpose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Subject

__all__ = ["points_charts"]

# Fewer points define neither a plane nor a meaningful spacing.
FEWEST = 8


def points_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of a cloud.

    - "neighbors": shares of wrong sets within a radius, by cell size, order and precision, and of warp's own hash grid.
    - "nearest": k nearest points, also within a radius, in float32, and with the tree built in the call.
    - "point_normals" and "torus_normals": by number of neighbors, against plane fits and against a known shape.
    - "downsample": methods by the distance from the points to the nearest kept point.

    Args:
        subject: A subject with points.
        device: Where the methods run.
        quick: Smaller inputs and fewer settings.
    Returns:
        The charts; nothing is computed before their trials are requested.
    Raises:
        InputError: The subject has no points, or fewer than eight.
    """
    from geokit.accuracy.charts.downsample import downsample_chart
    from geokit.accuracy.charts.neighbors import nearest_chart, neighbors_chart
    from geokit.accuracy.charts.point_normals import point_normals_charts
    from geokit.accuracy.charts.points_setup import PointsSetup

    if subject.points is None or len(subject.points) < FEWEST:
        raise InputError(f"subject: {subject.name!r} has no points, or fewer than {FEWEST}; give a cloud")
    setup = PointsSetup(subject.points, device, quick)
    charts = [neighbors_chart(setup), nearest_chart(setup)]
    return [*charts, *point_normals_charts(setup), downsample_chart(setup)]
