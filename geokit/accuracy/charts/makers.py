"""The charts of a subject: of a mesh, of the volumes that are made from it, of a volume as given, of a cloud.

Every answer is compared with an independent reference (geokit/accuracy/reference): float64 NumPy that shares no code
with the method, on a random subset with a fixed seed. The reference of a chart is computed once. Queries are on the
device before timing starts, and answers stay there. Nothing is computed before the trials of a chart are requested.
Tested in tests/accuracy/charts, which also makes methods worse on purpose.

Each function takes a subject, the device where the methods run, and whether inputs are smaller and settings fewer. It
raises InputError if the subject does not hold what the charts are of.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Subject
    from geokit.mesh.model.triangle_mesh import TriangleMesh

# Fewer points define neither a plane nor a meaningful spacing.
FEWEST = 8


def mesh_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of queries on a mesh.

    - "closest_point" and "closest_point_near": geokit's exact answers in float64 and float32, with search radii and
      with the tree built in the call, and warp's own query in float32; anywhere and near the surface.
    - "sign", "sign_hole", "sign_flips" and, unless quick, "sign_doubles": shares of wrong signs of every method, on the
      mesh, and on the mesh with a hole, with flipped faces and with doubled faces.
    - "first_hit": geokit's query, warp's own, and rays through level sets of several voxel sizes.
    - "first_hit_edges": shares of leaks of rays aimed at edges and vertices.
    - "normals", of closed meshes: gradients of level sets, by voxel size and order, against the normals of the faces.
    """
    from geokit.accuracy.charts.closest_point import closest_point_charts, sign_charts
    from geokit.accuracy.charts.first_hit import first_hit_charts
    from geokit.accuracy.charts.mesh_setup import MeshSetup
    from geokit.accuracy.charts.sampling import normals_chart

    setup = MeshSetup(_mesh_of(subject), device, quick)
    charts = [*closest_point_charts(setup), *sign_charts(setup), *first_hit_charts(setup)]
    return [*charts, normals_chart(setup)] if setup.is_closed else charts


def mesh_volume_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of the volumes that are made from a mesh.

    - "sdf_sampling": voxel size, order and codec of a level set against the exact distance; the sizes of the grids show
      the memory that a tolerance costs.
    - "from_mesh": voxel size, half width and method against exact distances at the active voxels.
    - "from_volume": voxel size, method and adaptivity of the conversion back, by the Hausdorff distance to the mesh.
    - "sdf_gradients": voxel size and order against the direction to the closest point.
    """
    from geokit.accuracy.charts.conversions import from_mesh_chart, from_volume_chart
    from geokit.accuracy.charts.sampling import sdf_gradients_chart, sdf_sampling_chart
    from geokit.accuracy.charts.volume_setup import NearSurface

    near = NearSurface(_mesh_of(subject, ", or see volume_charts"), device, quick)
    return [sdf_sampling_chart(near), from_mesh_chart(near), from_volume_chart(near), sdf_gradients_chart(near)]


def volume_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of a volume as given; none for a grid without active voxels.

    - "sampling" and "gradients": order and codec against the float64 interpolant of the original values.
    - "isosurface": method and adaptivity, by the distance of vertices from the level.
    - "volume_raycast", of level sets: codec against a fine ray march through the float64 interpolant.

    Raises:
        UnsupportedGridError: The grid's values are not floating point or quantized.
    """
    from geokit.accuracy.charts.conversions import isosurface_chart
    from geokit.accuracy.charts.sampling import gradients_chart, sampling_chart
    from geokit.accuracy.charts.volume_raycast import volume_raycast_chart
    from geokit.accuracy.charts.volume_setup import VolumePoints

    if subject.volume is None:
        raise InputError(f"subject: {subject.name!r} has no volume; give one, or see mesh_volume_charts")
    field = VolumePoints(subject.volume, device, quick)
    if field.volume.info.index_bounds is None or len(field.active) == 0:
        return []
    charts = [sampling_chart(field), gradients_chart(field), isosurface_chart(field)]
    return [*charts, volume_raycast_chart(field)] if field.is_level_set else charts


def points_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of a cloud of eight points or more.

    - "neighbors": shares of wrong sets within a radius, by cell size, order and precision, and of warp's own hash grid.
    - "nearest": k nearest points, also within a radius, in float32, and with the tree built in the call.
    - "point_normals" and "torus_normals": by number of neighbors, against plane fits and against a known shape.
    - "downsample": methods by the distance from the points to the nearest kept point.
    """
    from geokit.accuracy.charts import points as of_points

    if subject.points is None or len(subject.points) < FEWEST:
        raise InputError(f"subject: {subject.name!r} has no points, or fewer than {FEWEST}; give a cloud")
    setup = of_points.PointsSetup(subject.points, device, quick)
    charts = [of_points.neighbors_chart(setup), of_points.nearest_chart(setup)]
    return [*charts, *of_points.point_normals_charts(setup), of_points.downsample_chart(setup)]


def _mesh_of(subject: Subject, other: str = "") -> TriangleMesh:
    if subject.mesh is None or len(subject.mesh.faces) == 0:
        raise InputError(f"subject: {subject.name!r} has no mesh with faces; give one{other}")
    return subject.mesh
