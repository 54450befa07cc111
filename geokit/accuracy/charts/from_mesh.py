"""Chart of level sets made from a mesh, by voxel size, half width and method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.accuracy.charts.mesh_setup import HALF_WIDTH, area_samples
from geokit.accuracy.charts.volume_setup import SEED
from geokit.accuracy.reference.volume import Voxels
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, judged, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.volume_setup import Known, NearSurface
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["from_mesh_chart"]

HALF_WIDTHS = {True: (1.5, HALF_WIDTH), False: (1.5, HALF_WIDTH, 6.0)}
# OpenVDB's method takes ten times as long, in proportion to the triangles. It is measured only at the default half
# width, and in a quick chart once, for meshes of up to so many triangles.
QUICK_TRIANGLES = 15_000
# Voxels closer to the band's border than this share of a voxel may be active or not: band widths are float32.
BORDER = 1e-4
# Distances smaller than this share of a voxel have a sign determined by rounding.
SIGNED = 1e-4


def from_mesh_chart(near: NearSurface) -> Chart:
    """Errors of the active voxels of a level set, by voxel size, half width and method.

    Random voxels within the band are compared with their distance to the triangles by brute force in float64, with the
    sign of the winding number. Inactive voxels and wrong signs count as wrong. Voxels with a winding number of about
    one half, in the opening of an open mesh, are left out. The rate counts active voxels. OpenVDB's own method is
    included, at the default half width, if geokit was built with it and the mesh is closed.
    """
    title = "Level set of a mesh: its active voxels"
    return Chart("from_mesh", title, "world", "voxels", lambda: _trials(near))


def _trials(near: NearSurface) -> Iterator[Trial]:
    half_widths = HALF_WIDTHS[near.quick]
    methods = _methods(near)
    for voxel_size in near.voxel_sizes:
        expected = _expected(near, voxel_size, max(half_widths))
        for half_width in half_widths:
            for method in methods:
                usual = half_width == HALF_WIDTH and not (near.quick and voxel_size > min(near.voxel_sizes))
                if method == "geokit" or usual:
                    yield _trial(near, expected, {"voxel_size": voxel_size, "half_width": half_width, "method": method})


def _methods(near: NearSurface) -> tuple[str, ...]:
    from geokit import native
    from geokit.mesh._audit import audit

    slow = near.quick and len(near.mesh.faces) > QUICK_TRIANGLES
    return ("geokit", "openvdb") if native.available() and not slow and audit(near.mesh).watertight else ("geokit",)


def _trial(near: NearSurface, expected: Known, parameters: dict[str, Any]) -> Trial:
    name = f"volume.from_mesh, {parameters['method']}"
    voxel_size, half_width, method = parameters.values()

    def make() -> SparseVolume:
        return near.level_set(voxel_size, half_width=half_width, method=method)

    try:
        # One untimed run gives the number of voxels.
        info = make().info
    except Exception as error:
        return failed(name, parameters, error)
    judge = _judge(expected, voxel_size, half_width)
    return Trial(name, setting_of(parameters), make, judge, info.active_voxel_count or 0, info.byte_count, parameters)


def _judge(expected: Known, voxel_size: float, half_width: float) -> Any:
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
