"""Charts of volumes: time and error of sampling, level sets, surfaces, rays and gradients.

Every answer is compared with an independent reference (geokit/accuracy/reference/mesh.py and volume.py): float64 NumPy
that shares no code with the method, on a random subset with a fixed seed. The reference of a chart is computed once.
Queries are on the device before timing starts. Tested in tests/accuracy/charts/test_volume_charts.py, which also makes
methods worse on purpose.

geokit writes no grids of half floats, so "half" is not among the codecs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Subject

__all__ = ["mesh_volume_charts", "volume_charts"]


def mesh_volume_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of the volumes that are made from a mesh.

    - "sdf_sampling": voxel size, order and codec of a level set against the exact distance; the sizes of the grids show
      the memory that a tolerance costs.
    - "from_mesh": voxel size, half width and method against exact distances at the active voxels.
    - "from_volume": voxel size, method and adaptivity of the conversion back, by the Hausdorff distance to the mesh.
    - "sdf_gradients": voxel size and order against the direction to the closest point.

    Args:
        subject: A subject with a mesh.
        device: Where the methods run.
        quick: Smaller inputs and fewer settings.
    Returns:
        The charts; nothing is computed before their trials are requested.
    Raises:
        InputError: The subject has no mesh, or one without faces.
    """
    from geokit.accuracy.charts.from_mesh import from_mesh_chart
    from geokit.accuracy.charts.from_volume import from_volume_chart
    from geokit.accuracy.charts.gradients import sdf_gradients_chart
    from geokit.accuracy.charts.sampling import sdf_sampling_chart
    from geokit.accuracy.charts.volume_setup import NearSurface

    if subject.mesh is None or len(subject.mesh.faces) == 0:
        raise InputError(f"subject: {subject.name!r} has no mesh with faces; give one, or see volume_charts")
    near = NearSurface(subject.mesh, device, quick)
    return [sdf_sampling_chart(near), from_mesh_chart(near), from_volume_chart(near), sdf_gradients_chart(near)]


def volume_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of a volume as given.

    - "sampling" and "gradients": order and codec against the float64 interpolant of the original values.
    - "isosurface": method and adaptivity, by the distance of vertices from the level.
    - "volume_raycast", of level sets: codec against a fine ray march through the float64 interpolant.

    Args:
        subject: A subject with a volume.
        device: Where the methods run.
        quick: Smaller inputs and fewer settings.
    Returns:
        The charts; none for a grid without active voxels.
    Raises:
        InputError: The subject has no volume.
        UnsupportedGridError: The grid's values are not floating point or quantized.
    """
    from geokit.accuracy.charts.from_volume import isosurface_chart
    from geokit.accuracy.charts.gradients import gradients_chart
    from geokit.accuracy.charts.sampling import sampling_chart
    from geokit.accuracy.charts.volume_points import VolumePoints
    from geokit.accuracy.charts.volume_raycast import volume_raycast_chart

    if subject.volume is None:
        raise InputError(f"subject: {subject.name!r} has no volume; give one, or see mesh_volume_charts")
    field = VolumePoints(subject.volume, device, quick)
    if field.volume.info.index_bounds is None or len(field.active) == 0:
        return []
    charts = [sampling_chart(field), gradients_chart(field), isosurface_chart(field)]
    return [*charts, volume_raycast_chart(field)] if field.is_level_set else charts
