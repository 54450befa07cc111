"""Charts of samples and gradients of volumes, by voxel size, order and codec: error, time and memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.charts.first_hit import DIVISIONS, QUICK_DIVISIONS
from geokit.accuracy.charts.mesh_setup import HALF_WIDTH, MOST, SEED, area_samples
from geokit.accuracy.charts.volume_setup import QUICK_CODECS, coded, known_codecs
from geokit.accuracy.reference import mesh as reference
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import angles, failed, judged, on_host, send, setting_of, unit
from geokit.errors import GeokitError

if TYPE_CHECKING:
    from geokit.accuracy.charts.mesh_setup import MeshSetup
    from geokit.accuracy.charts.volume_setup import Known, NearSurface, VolumePoints
    from geokit.mesh.model.triangle_mesh import TriangleMesh
    from geokit.volume.model.sparse_volume import SparseVolume

ORDERS = (0, 1, 2, 3)

# Largest distance along an axis between a point and the voxels of its cubic stencil [voxels].
REACH = 2.0
CORNERS = 8
# Least number of checked points, if as many are known.
FEWEST = 64
# Within the stencil the surface may turn by this much [degrees]; beyond it, the surface is not resolved.
TURN = 30.0
# Closer to the surface than this share of the diagonal, the direction to it has too few digits.
NEAREST = 1e-9


def sdf_sampling_chart(near: NearSurface) -> Chart:
    """Errors of sampled level sets of a mesh against the exact distance, by voxel size, order and codec.

    The queries lie up to half the smallest voxel from the surface. The reference is the distance to the triangles by
    brute force in float64, negative where the winding number of the consistently oriented mesh exceeds one half. Points
    where the sign is ambiguous, in the opening of an open mesh, are left out.
    """
    title = "Distance near a mesh, sampled from its level set"
    return Chart("sdf_sampling", title, "world", "samples", lambda: _sdf_trials(near))


def _sdf_trials(near: NearSurface) -> Iterator[Trial]:
    points = send(near.points, near.device)

    def judge(answer: Any) -> Judgement:
        return judged(on_host(answer)[near.known.rows] - near.known.distance, near.known.points)

    for voxel_size in near.voxel_sizes:
        try:
            band = near.level_set(voxel_size)
        except Exception as error:
            yield failed("volume.from_mesh", {"voxel_size": voxel_size}, error)
            continue
        # A quick chart has all codecs only for its smallest voxels.
        for codec in QUICK_CODECS if near.quick and voxel_size != min(near.voxel_sizes) else known_codecs():
            try:
                grid = coded(band, codec, 2.0 * HALF_WIDTH * voxel_size)
            except Exception as error:
                yield failed("volume.quantize", {"voxel_size": voxel_size, "codec": codec}, error)
                continue
            for order in ORDERS:
                parameters = {"voxel_size": voxel_size, "order": order, "codec": codec}
                yield _query_trial("sample", parameters, grid, points, judge, near.device)


def sampling_chart(field: VolumePoints) -> Chart:
    """Errors of samples of a volume against its own interpolant, by order and codec.

    The reference for each order is the interpolant of that order of the original values, summed in float64 NumPy: float
    grids show only the rounding of sampling, and codecs their loss. Errors are in world units for level sets, else
    relative to the range of the values.
    """
    title = "Values of a volume, as stored and in fewer bits"

    def judge(answer: Any, order: int) -> Judgement:
        off = on_host(answer)[field.rows] - field.sampled(order)
        return judged(off / field.error_scale, field.points[field.rows])

    return Chart(
        "sampling", title, field.unit, "samples", lambda: _volume_trials("sample", field, known_codecs(), judge)
    )


def _volume_trials(
    name: str, field: VolumePoints, codecs: Sequence[str], judge: Callable[[Any, int], Judgement]
) -> Iterator[Trial]:
    """Trials of a method of volumes at every order, of a volume as stored by each codec."""
    points = send(field.points, field.device)
    for codec in codecs:
        try:
            grid = coded(field.volume, codec, field.value_range)
        except Exception as error:
            yield failed("volume.quantize", {"codec": codec}, error)
            continue
        for order in ORDERS:
            parameters = {"order": order, "codec": codec}

            def judge_order(answer: Any, order: int = order) -> Judgement:
                return judge(answer, order)

            yield _query_trial(name, parameters, grid, points, judge_order, field.device)


def _query_trial(
    name: str,
    parameters: dict[str, Any],
    grid: SparseVolume,
    points: Any,
    judge: Callable[[Any], Judgement],
    device: Any,
) -> Trial:
    """A trial of a method of volumes: "sample", or "gradient"."""
    order = parameters["order"]

    def run() -> Any:
        return getattr(grid, name)(points, order=order, device=device)

    method = f"volume.{name}, order {order}"
    return Trial(method, setting_of(parameters), run, judge, len(points), grid.info.byte_count, parameters)


def sdf_gradients_chart(near: NearSurface) -> Chart:
    """Angles between gradients of level sets of a mesh and the direction to its closest point, by voxel size and order.

    For each voxel size, points near the medial axis or an edge are left out: those where the closest face, or the
    direction to it, turns by more than 30 degrees between the point and a corner of the stencil of order 3 (two voxels
    to each side). A voxel size without remaining points has no trials. A gradient of length 0 is wrong.
    """
    title = "Gradient near a mesh, from its level set"
    return Chart("sdf_gradients", title, "degrees", "gradients", lambda: _sdf_gradient_trials(near))


def _sdf_gradient_trials(near: NearSurface) -> Iterator[Trial]:
    points = send(near.points, near.device)
    # Eight more references for each point: an eighth of the checked points is as much work, and some points are left
    # out.
    step = max(1, min(CORNERS, len(near.known.rows) // FEWEST))
    known = near.known.take(np.arange(0, len(near.known.rows), step))
    for voxel_size in near.voxel_sizes:
        chosen = known.take(_is_smooth(near.oriented, known, voxel_size))
        if not len(chosen.rows):
            continue
        outward = unit(chosen.points - chosen.closest) * np.sign(chosen.distance)[:, None]

        def judge(answer: Any, chosen: Known = chosen, outward: NDArray[np.float64] = outward) -> Judgement:
            return judged(angles(on_host(answer)[chosen.rows], outward), chosen.points)

        try:
            band = near.level_set(voxel_size)
        except Exception as error:
            yield failed("volume.from_mesh", {"voxel_size": voxel_size}, error)
            continue
        for order in ORDERS:
            yield _query_trial("gradient", {"voxel_size": voxel_size, "order": order}, band, points, judge, near.device)


def _is_smooth(mesh: TriangleMesh, known: Known, voxel_size: float) -> NDArray[np.bool_]:
    """Mask of points within whose stencil the closest face and the direction to it turn by little."""
    corners = REACH * voxel_size * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0)
    around = (known.points[:, None] + corners).reshape(-1, 3)
    found = reference.closest_point(mesh.vertices, mesh.faces, around)
    normals = reference.face_normals(mesh.vertices, mesh.faces)
    least = np.cos(np.radians(TURN))
    normal = (normals[known.triangle_id][:, None] * normals[found.triangle_id].reshape(-1, CORNERS, 3)).sum(axis=2)
    # In either direction: the corners lie on both sides of the surface.
    here, there = unit(known.points - known.closest), unit(around - found.points).reshape(-1, CORNERS, 3)
    turned = np.abs((here[:, None] * there).sum(axis=2))
    defined = np.abs(known.distance) > NEAREST * mesh.diagonal
    return defined & (normal >= least).all(axis=1) & (turned >= least).all(axis=1)


def gradients_chart(field: VolumePoints) -> Chart:
    """Errors of gradients of a volume against its own interpolant, by order and codec.

    The reference for each order is the gradient of the interpolant of that order of the original values, in float64
    NumPy (central differences for order 0). An error is the length of the difference over the root mean square of the
    lengths of the reference.
    """
    title = "Gradients of a volume, as stored and in fewer bits"

    def judge(answer: Any, order: int) -> Judgement:
        wanted = field.gradients(order)
        scale = float(np.sqrt((wanted * wanted).sum(axis=1).mean())) or 1.0
        off = np.linalg.norm(on_host(answer)[field.rows] - wanted, axis=1)
        return judged(off / scale, field.points[field.rows])

    def trials() -> Iterator[Trial]:
        return _volume_trials("gradient", field, QUICK_CODECS if field.quick else known_codecs(), judge)

    return Chart("gradients", title, "relative", "gradients", trials)


def normals_chart(setup: MeshSetup) -> Chart:
    """Angles between gradients of level sets and the normals of the faces on which the points lie.

    The largest error is at edges between faces, which no field of finite voxels resolves. A gradient of length 0 is
    wrong.
    """
    title = "Normal on the surface, from a level set"
    return Chart("normals", title, "degrees", "gradients", lambda: _normal_trials(setup))


def _normal_trials(setup: MeshSetup) -> Iterator[Trial]:
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
