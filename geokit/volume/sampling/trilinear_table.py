"""Trilinear samples and gradients of a float grid at many points, through its leaf table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.interop import user_arrays
from geokit.core.launches.late_checks import later
from geokit.core.memory.needs import is_out_of_memory
from geokit.core.memory.pinned import host_flags
from geokit.volume.sampling.leaf_table import leaf_table, made_table
from geokit.volume.sampling.space import world_to_index

if TYPE_CHECKING:
    from geokit.volume.model.sparse_volume import SparseVolume

# Fewest groups of queries per thread.
GRAIN = 16


def sample_linear(volume: SparseVolume, points: Any, space: str, device: "wp.Device") -> Any:
    """Bit-identical to :func:`geokit.volume.sample` of order 1; None if the tree walk is as fast.

    Args:
        volume: Any grid.
        points: Query points, shape (N, 3).
        space: Their coordinates, "world" or "index".
        device: Where to compute.
    Raises:
        InputError: points is not (N, 3) or not finite.
    """
    return _answer(volume, points, space, device, gradient=False)


def gradient_linear(volume: SparseVolume, points: Any, space: str, device: "wp.Device") -> Any:
    """Gradients (N, 3) [value / world]; arguments and None as for :func:`sample_linear`."""
    return _answer(volume, points, space, device, gradient=True)


def _answer(volume: SparseVolume, points: Any, space: str, device: "wp.Device", *, gradient: bool) -> Any:
    table = leaf_table(volume, device, _count(points))
    if table is None:
        return None
    from geokit.volume.sampling import trilinear_table_kernels as kernels

    batch = user_arrays.read_vectors(points, "points", device, defer=True, keep_float32=True, single=True)
    count = len(batch)
    if gradient:
        choices = kernels.GRADIENT_CPU if device.is_cpu else kernels.GRADIENT_CUDA
        kinds, background = (wp.vec3f, wp.vec3d), wp.vec3d(0.0, 0.0, 0.0)
    else:
        choices = kernels.SAMPLE_CPU if device.is_cpu else kernels.SAMPLE_CUDA
        kinds, background = (wp.float32, wp.float64), wp.float64(volume.info.background)
    out = user_arrays.empty(count, kinds[0] if batch.is_float32 else kinds[1], batch.rows)
    bad = host_flags(1, device)
    inputs = [wp.uint64(volume.id(device)), table, batch.rows, *world_to_index(volume, space), background]
    items = -(-count // kernels.GROUP) if device.is_cpu else count
    launcher.launch(choices[batch.is_float32], items, inputs, [out, bad], device, grain=GRAIN if device.is_cpu else 0)

    def check() -> None:
        if count and bad.numpy()[0]:
            user_arrays.require_finite(batch, "points")

    if not batch.is_shared:
        check()
        return batch.to_caller(out)
    answer = batch.to_caller(out)
    later(check, device)
    return answer


def sample_and_slopes(volume: SparseVolume, points: Any, space: str, device: "wp.Device") -> Any:
    """Samples (N,) and gradients (N, 3), each with its own bits, from one pass over the voxels.

    Args:
        volume: Any grid.
        points: A tensor of torch, shape (N, 3), float32 or float64, on the device.
        space: Its coordinates, "world" or "index".
        device: Where to compute.
    Returns:
        Two tensors; None if the grid has no table yet, or there is no memory for both.
    Raises:
        InputError: points is not finite.
    """
    from geokit.core.gradients.tensor_rows import TensorRows, launch, number_of
    from geokit.volume.sampling.trilinear_slopes_kernels import AT_ONCE

    table = made_table(volume, device)
    if table is None:
        return None
    try:
        value, slopes = points.new_empty(points.shape[0]), points.new_empty(points.shape)
    except RuntimeError as error:
        if is_out_of_memory(error):
            return None
        raise
    bad = host_flags(1, device)
    handle, place = volume._uploads[device.alias][0].id, world_to_index(volume, space)
    inputs = [wp.uint64(handle), table, TensorRows(points), *place, wp.float64(volume.info.background)]
    outputs = [TensorRows(value), TensorRows(slopes), bad]
    launch(AT_ONCE[number_of(points)], points.shape[0], inputs, outputs, device)

    def check() -> None:
        if bad.numpy()[0]:
            user_arrays.read_vectors(points, "points", device)

    later(check, device)
    return value, slopes


def _count(points: Any) -> int:
    try:
        return len(points)
    except Exception:  # of the caller's own type; the points are read and refused later
        return 0
