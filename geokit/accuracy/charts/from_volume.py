"""Charts of surfaces made from volumes: their distance from the original mesh, or from the level of the interpolant."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.accuracy.charts.volume_setup import SEED, Effort, surface_samples
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.reference.volume import nearest_to_level
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, judged, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.volume_points import VolumePoints
    from geokit.accuracy.charts.volume_setup import NearSurface
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["from_volume_chart", "isosurface_chart"]

OWN = ("surface_nets", "marching_cubes", "dual_contouring")
ADAPTIVITIES = {True: (0.0, 0.5), False: (0.0, 0.1, 0.5, 1.0)}
# Gradients shorter than this share of the value range per voxel give no reliable distance.
FLAT = 1e-3


def from_volume_chart(near: NearSurface) -> Chart:
    """Hausdorff distance between a mesh and the surface of its level set, by voxel size, method and adaptivity.

    The distance is sampled: errors are the distances of points of the result from the mesh, and of points of the mesh
    from the result, by brute force in float64; half of the points are vertices. The level set's size is the reported
    memory.
    """
    title = "Mesh to level set and back: Hausdorff distance to the mesh"
    return Chart("from_volume", title, "world", "triangles", lambda: _round_trips(near))


def _round_trips(near: NearSurface) -> Iterator[Trial]:
    asked = surface_samples(near.mesh, near.effort.checked, SEED + 3)

    def judge(result: TriangleMesh) -> Judgement:
        if len(result.faces) == 0:
            return judged(np.full(len(asked), np.inf), asked)
        # Fewer points if the result has more triangles than the mesh: each point is compared with each triangle.
        count = Effort.of(near.device, near.quick, len(result.faces)).checked
        to, back = asked[:count], surface_samples(result, near.effort.checked, SEED + 4)
        there = reference.closest_point(result.vertices, result.faces, to).distance
        here = reference.closest_point(near.mesh.vertices, near.mesh.faces, back).distance
        return judged(np.concatenate([there, here]), np.concatenate([to, back]))

    for voxel_size in near.voxel_sizes:
        try:
            band = near.level_set(voxel_size)
        except Exception as error:
            yield failed("volume.from_mesh", {"voxel_size": voxel_size}, error)
            continue
        for parameters in _settings(near.quick):
            yield _trial(band, 0.0, {"voxel_size": voxel_size, **parameters}, judge, near.device)


def isosurface_chart(field: VolumePoints) -> Chart:
    """Distance of the vertices of an isosurface from the level of the volume's interpolant, by method and adaptivity.

    The distance is the difference of the interpolant from the isovalue over the length of its gradient, in float64
    NumPy, correct to first order. Vertices with a gradient shorter than a thousandth of the value range per voxel are
    left out. The isovalue is 0 for a level set, else the median of the active voxels.
    """
    title = "Isosurface of a volume: distance of its vertices from the level"
    return Chart("isosurface", title, "world", "triangles", lambda: _isosurfaces(field))


def _isosurfaces(field: VolumePoints) -> Iterator[Trial]:
    flat = FLAT * field.value_range / float(field.volume.info.voxel_size.max())

    def judge(result: TriangleMesh) -> Judgement:
        used = np.unique(result.faces)
        rng = np.random.default_rng(SEED + 3)
        at = result.vertices[rng.choice(used, min(field.effort.checked, len(used)), replace=False)]
        hit = nearest_to_level(field.voxels, at, field.isovalue, flat)
        return judged(hit.distance[hit.steep], at[hit.steep])

    for parameters in _settings(field.quick):
        yield _trial(field.volume, field.isovalue, {**parameters, "isovalue": field.isovalue}, judge, field.device)


@cache
def _settings(quick: bool) -> tuple[dict[str, Any], ...]:
    from geokit import native

    own = [{"method": method, "adaptivity": 0.0} for method in OWN]
    adaptivities = ADAPTIVITIES[quick] if native.available() else ()
    return (*own, *({"method": "openvdb", "adaptivity": adaptivity} for adaptivity in adaptivities))


def _trial(volume: SparseVolume, isovalue: float, parameters: dict[str, Any], judge: Any, device: Any) -> Trial:
    method, adaptivity = parameters["method"], parameters["adaptivity"]
    name = f"mesh.from_volume, {method}"

    def make() -> TriangleMesh:
        from geokit.mesh.volumes.from_volume import from_volume

        mesh = from_volume(volume, isovalue=isovalue, adaptivity=adaptivity, method=method, device=device)
        mesh.faces  # noqa: B018 - in NumPy, as OpenVDB's are
        return mesh

    try:
        # One untimed run gives the number of triangles.
        count = len(make().faces)
    except Exception as error:
        return failed(name, parameters, error)
    told = {**parameters, "triangle_count": count}
    return Trial(name, setting_of(parameters), make, judge, count, volume.info.byte_count, told)
