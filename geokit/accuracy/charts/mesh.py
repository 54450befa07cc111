"""Charts of meshes: time and error of closest points, signs, first hits and normals.

Every answer is compared with an independent reference (geokit/accuracy/reference): float64 NumPy that shares no code
with the method, on a random subset with a fixed seed. The reference of a chart is computed once. Queries are on the
device before timing starts, and answers stay there. Tested in tests/accuracy/charts/test_mesh_charts.py, which also
makes methods worse on purpose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Subject

__all__ = ["mesh_charts"]


def mesh_charts(subject: Subject, device: Any, quick: bool) -> list[Chart]:
    """Charts of queries on a mesh.

    - "closest_point" and "closest_point_near": geokit's exact answers in float64 and float32, with search radii and
      with the tree built in the call, and warp's own query in float32; anywhere and near the surface.
    - "sign", "sign_hole", "sign_flips" and, unless quick, "sign_doubles": shares of wrong signs of every method, on the
      mesh, and on the mesh with a hole, with flipped faces and with doubled faces.
    - "first_hit": geokit's query, warp's own, and rays through level sets of several voxel sizes.
    - "first_hit_edges": shares of leaks of rays aimed at edges and vertices.
    - "normals", of closed meshes: gradients of level sets, by voxel size and order, against the normals of the faces.

    Args:
        subject: A subject with a mesh.
        device: Where the methods run.
        quick: Smaller inputs and fewer settings.
    Returns:
        The charts; nothing is computed before their trials are requested.
    Raises:
        InputError: The subject has no mesh, or one without faces.
    """
    from geokit.accuracy.charts.closest_point import closest_point_charts
    from geokit.accuracy.charts.first_hit import first_hit_charts
    from geokit.accuracy.charts.mesh_normals import normals_chart
    from geokit.accuracy.charts.mesh_setup import MeshSetup
    from geokit.accuracy.charts.sign import sign_charts

    if subject.mesh is None or len(subject.mesh.faces) == 0:
        raise InputError(f"subject: {subject.name!r} has no mesh with faces; give one")
    setup = MeshSetup(subject.mesh, device, quick)
    charts = [*closest_point_charts(setup), *sign_charts(setup), *first_hit_charts(setup)]
    return [*charts, normals_chart(setup)] if setup.is_closed else charts
