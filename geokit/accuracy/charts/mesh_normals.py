"""Chart of surface normals of a mesh computed from its distance field."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.accuracy.charts.first_hit import DIVISIONS, QUICK_DIVISIONS
from geokit.accuracy.charts.mesh_setup import MOST, SEED, area_samples
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import angles, failed, judged, on_host, send, setting_of
from geokit.errors import GeokitError

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup

__all__ = ["normals_chart"]

ORDERS = (0, 1, 2, 3)


def normals_chart(setup: MeshSetup) -> Chart:
    """Angles between gradients of level sets and the normals of the faces on which the points lie.

    The largest error is at edges between faces, which no field of finite voxels resolves. A gradient of length 0 is
    wrong.
    """
    title = "Normal on the surface, from a level set"
    return Chart("normals", title, "degrees", "gradients", lambda: _trials(setup))


def _trials(setup: MeshSetup) -> Iterator[Trial]:
    mesh = setup.oriented
    samples, face = area_samples(mesh, setup.count, np.random.default_rng(SEED + 6))
    points = send(samples, setup.device)
    rows = np.arange(min(MOST, setup.count))
    normals = reference.face_normals(mesh.vertices, mesh.faces[face[rows]])

    def judge(answer: Any) -> Judgement:
        return judged(angles(on_host(answer)[rows], normals), samples[rows])

    for parts in QUICK_DIVISIONS if setup.quick else DIVISIONS:
        voxel_size = setup.shared(1.0 / parts)
        try:
            volume = setup.level_set(voxel_size)
        except GeokitError as error:
            yield failed("volume.gradient", {"voxel_size": voxel_size}, error)
            continue
        for order in ORDERS:
            chosen = {"voxel_size": voxel_size, "order": order}
            run = partial(volume.gradient, points, order=order, device=setup.device)
            size = volume.info.byte_count
            yield Trial(f"gradient, order {order}", setting_of(chosen), run, judge, setup.count, size, chosen)
