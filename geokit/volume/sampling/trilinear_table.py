"""Trilinear samples and gradients of a float grid at many points, through its leaf table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from geokit.core import launcher, user_arrays
from geokit.core.memory.pinned import host_flags
from geokit.volume.sampling.leaf_table import leaf_table
from geokit.volume.sampling.space import world_to_index

if TYPE_CHECKING:
    import warp as wp

    from geokit.volume._model import SparseVolume

__all__ = ["gradient_linear", "sample_linear"]

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
    import warp as wp

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
    if count and bad.numpy()[0]:
        user_arrays.require_finite(batch, "points")
    return batch.to_caller(out)


def _count(points: Any) -> int:
    try:
        return len(points)
    except Exception:  # of the caller's own type; the points are read and refused later
        return 0
