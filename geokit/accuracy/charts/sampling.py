"""Charts of sampling: error, time and memory by voxel size, order and codec."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from geokit.accuracy.charts.mesh_setup import HALF_WIDTH
from geokit.accuracy.charts.volume_setup import QUICK_CODECS, coded, known_codecs
from geokit.accuracy.trials.model import Chart, Judgement, Trial
from geokit.accuracy.trials.running import failed, judged, on_host, send, setting_of

if TYPE_CHECKING:
    from geokit.accuracy.charts.volume_setup import NearSurface, VolumePoints
    from geokit.volume.model.sparse_volume import SparseVolume

__all__ = ["query_trial", "sampling_chart", "sdf_sampling_chart", "volume_trials"]

ORDERS = (0, 1, 2, 3)


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
                yield query_trial("sample", parameters, grid, points, judge, near.device)


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
        "sampling", title, field.unit, "samples", lambda: volume_trials("sample", field, known_codecs(), judge)
    )


def volume_trials(
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

            yield query_trial(name, parameters, grid, points, judge_order, field.device)


def query_trial(
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
