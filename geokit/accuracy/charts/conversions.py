"""Charts of conversions: level sets made from a mesh, and surfaces made from volumes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit import native
from geokit.accuracy.charts.mesh_setup import HALF_WIDTH, area_samples
from geokit.accuracy.charts.volume_setup import SEED, Effort, surface_samples
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.reference.volume import Voxels, nearest_to_level
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, judged, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.volume_setup import Known, NearSurface, VolumePoints
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

HALF_WIDTHS = {True: (1.5, HALF_WIDTH), False: (1.5, HALF_WIDTH, 6.0)}
# OpenVDB's method takes ten times as long, in proportion to the triangles. It is measured only at the default half
# width, and in a quick chart once, for meshes of up to so many triangles.
QUICK_TRIANGLES = 15_000
# Voxels closer to the band's border than this share of a voxel may be active or not: band widths are float32.
BORDER = 1e-4
# Distances smaller than this share of a voxel have a sign determined by rounding.
SIGNED = 1e-4
OWN = ("surface_nets", "marching_cubes", "dual_contouring")
ADAPTIVITIES = {True: (0.0, 0.5), False: (0.0, 0.1, 0.5, 1.0)}
# Gradients shorter than this share of the value range per voxel give no reliable distance.
FLAT = 1e-3


def from_mesh_chart(near: NearSurface) -> Chart:
    """Errors of the active voxels of a level set, by voxel size, half width and method.

    Random voxels within the band are compared with their distance to the triangles by brute force in float64, with the
    sign of the winding number. Inactive voxels and wrong signs count as wrong. Voxels with a winding number of about
    one half, in the opening of an open mesh, are left out. The rate counts active voxels. OpenVDB's own method is
    included, at the default half width, if geokit was built with it and the mesh is closed.
    """
    title = "Level set of a mesh: its active voxels"
    return Chart("from_mesh", title, "world", "voxels", lambda: _level_sets(near))


def _level_sets(near: NearSurface) -> Iterator[Trial]:
    half_widths = HALF_WIDTHS[near.quick]
    methods = _methods(near)
    for voxel_size in near.voxel_sizes:
        expected = _expected(near, voxel_size, max(half_widths))
        for half_width in half_widths:
            for method in methods:
                usual = half_width == HALF_WIDTH and not (near.quick and voxel_size > min(near.voxel_sizes))
                if method == "geokit" or usual:
                    yield _band(near, expected, {"voxel_size": voxel_size, "half_width": half_width, "method": method})


def _methods(near: NearSurface) -> tuple[str, ...]:
    from geokit.mesh._audit import audit

    slow = near.quick and len(near.mesh.faces) > QUICK_TRIANGLES
    return ("geokit", "openvdb") if native.available() and not slow and audit(near.mesh).watertight else ("geokit",)


def _band(near: NearSurface, expected: Known, parameters: dict[str, Any]) -> Trial:
    name = f"volume.from_mesh, {parameters['method']}"
    voxel_size, half_width, method = parameters.values()

    def make() -> SparseVolume:
        return near.level_set(voxel_size, half_width=half_width, method=method)

    try:
        # One untimed run gives the number of voxels.
        info = make().info
    except Exception as error:
        return failed(name, parameters, error)
    judge = _judge_band(expected, voxel_size, half_width)
    return Trial(name, setting_of(parameters), make, judge, info.active_voxel_count or 0, info.byte_count, parameters)


def _judge_band(expected: Known, voxel_size: float, half_width: float) -> Any:
    inside = np.abs(expected.distance) < (half_width - BORDER) * voxel_size
    centers, distance = expected.points[inside], expected.distance[inside]

    def judge(volume: SparseVolume) -> Judgement:
        voxels = Voxels(volume)
        values, active = voxels.leaf_values(np.rint(voxels.to_index(centers)).astype(np.int64))
        other_side = (np.sign(values) != np.sign(distance)) & (np.abs(distance) > SIGNED * voxel_size)
        return judged(values - distance, centers, ~active | other_side)

    return judge


def _expected(near: NearSurface, voxel_size: float, half_width: float) -> Known:
    """Random voxels in the widest band of that voxel size."""
    count = near.effort.checked
    rng = np.random.default_rng(SEED + 2)
    points, _ = area_samples(near.mesh, count, rng)
    reach = half_width * voxel_size
    offset = rng.normal(size=points.shape)
    offset *= reach * rng.random((count, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    # Voxel centers lie at whole multiples of the voxel size.
    centers = np.unique(np.rint((points + offset) / voxel_size), axis=0) * voxel_size
    return near.truth(centers, np.arange(len(centers)))


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
            yield _surface(band, 0.0, {"voxel_size": voxel_size, **parameters}, judge, near.device)


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
        yield _surface(field.volume, field.isovalue, {**parameters, "isovalue": field.isovalue}, judge, field.device)


@cache
def _settings(quick: bool) -> tuple[dict[str, Any], ...]:
    own = [{"method": method, "adaptivity": 0.0} for method in OWN]
    adaptivities = ADAPTIVITIES[quick] if native.available() else ()
    return (*own, *({"method": "openvdb", "adaptivity": adaptivity} for adaptivity in adaptivities))


def _surface(volume: SparseVolume, isovalue: float, parameters: dict[str, Any], judge: Any, device: Any) -> Trial:
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
