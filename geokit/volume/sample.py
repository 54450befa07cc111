"""Values and gradients of a sparse volume at any world points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit import _launch
from geokit._arrays import read_vectors
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.model import SparseVolume

if TYPE_CHECKING:
    import warp as wp

__all__ = ["gradient", "sample"]

ORDERS = {0: "nearest voxel", 1: "trilinear"}

_COMPONENTS = {
    **dict.fromkeys(("float", "double", "half", "fp4", "fp8", "fp16", "fpn"), 1),
    **dict.fromkeys(("int16", "int32", "int64", "uint8", "uint32", "bool", "mask"), 1),
    **dict.fromkeys(("vec3f", "vec3d", "vec3u8", "vec3u16"), 3),
    **dict.fromkeys(("vec4f", "vec4d", "rgba8"), 4),
}


def sample(volume: SparseVolume, points: Any, *, order: int = 1, device: Any = None) -> Any:
    """Value of a volume at each point.

    Order 0 takes the voxel whose centre is nearest (halves round up in index space), order 1 interpolates the eight
    voxels around the point trilinearly. Every voxel counts with the tree's own value: outside the active voxels that
    is the tile's value or the background. Points whose index coordinates lie beyond int32, or within two voxels of its
    ends, get the background.

    All arithmetic is float64. World to index is ``inverse(linear) @ (point - translation)``: the position is off by a
    few times 2^-53 of the largest coordinate that takes part, and a linear field is reproduced to a few times 2^-53 of
    its values plus that. Where the eight voxels are equal the result is their value exactly. int64 voxels beyond 2^53
    are rounded to float64. A voxel that is not finite makes NaN of the samples in the cells around it. Held by
    tests/unit/test_sample.py, tests/property/test_sample.py and tests/stability/test_sample_far.py.

    Args:
        volume: Any scalar or vector grid.
        points: Query points [world], shape (N, 3).
        order: 0 or 1.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Values in the container of ``points``, float64 (float32 where the points are): shape (N,) for scalar grids, bool
        and mask grids as 0 and 1, (N, 3) and (N, 4) for vector and colour grids. Integers keep their stored range.
    Raises:
        InputError: points is not (N, 3) or not finite, or the order is not supported.
        UnsupportedGridError: The grid stores indices or points instead of values.
    """
    import warp as wp

    from geokit.volume._sample_kernels import SAMPLE_KERNELS

    order = _require_order(order)
    components = _require_components(volume)
    target = _launch.resolve_device(device)
    batch = read_vectors(points, "points", target)
    dtype = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components]
    background = dtype(*np.atleast_1d(volume.info.background).astype(np.float64).tolist())
    out = wp.empty(len(batch), dtype=dtype, device=target)
    inputs = [*_inputs(volume, batch.array), background]
    _launch.launch(SAMPLE_KERNELS[order][components], len(batch), inputs, [out], target)
    return batch.give(_view(out, wp.float64, (len(batch), 4)) if components == 4 else out)


def gradient(volume: SparseVolume, points: Any, *, order: int = 1, device: Any = None) -> Any:
    """World-space gradient of a volume at each point.

    Order 1 is the exact gradient of the trilinear interpolant: it jumps between cells, and at a cell's border it is
    that of the cell on the side of larger indices. Order 0 takes central differences of the voxels beside the nearest
    one: constant around each voxel, and of second order at voxel centres. Both are computed along the index axes in
    float64 and brought to world space by the inverse transpose of the transform, so that rotated, sheared and
    non-uniform voxels give world gradients. Constant regions, and points beyond int32, give exactly 0.

    Args:
        volume: Any scalar or vector grid.
        points: Query points [world], shape (N, 3).
        order: 0 or 1.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Gradients [value / world] in the container of ``points``, float64 (float32 where the points are): shape (N, 3)
        for scalar grids; for grids of C components the Jacobian, shape (N, C, 3), last axis the world axis.
    Raises:
        InputError: points is not (N, 3) or not finite, or the order is not supported.
        UnsupportedGridError: The grid stores indices or points instead of values.
    """
    import warp as wp

    from geokit.volume._sample_kernels import GRADIENT_KERNELS

    order = _require_order(order)
    components = _require_components(volume)
    target = _launch.resolve_device(device)
    batch = read_vectors(points, "points", target)
    count = len(batch)
    out = wp.empty((count, components, 3), dtype=wp.float64, device=target)
    zero = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components](0.0)
    inputs = [*_inputs(volume, batch.array), zero]
    _launch.launch(GRADIENT_KERNELS[order][components], count, inputs, [out], target)
    return batch.give(_view(out, wp.vec3d, (count,)) if components == 1 else out)


def _require_order(order: Any) -> int:
    if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or int(order) not in ORDERS:
        known = ", ".join(f"{number} ({name})" for number, name in ORDERS.items())
        raise InputError(f"order: {order!r} is not supported; use one of {known}")
    return int(order)


def _require_components(volume: SparseVolume) -> int:
    found = _COMPONENTS.get(volume.info.grid_type)
    if found is None:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} stores no values that can be "
            f"interpolated; convert it to one of {', '.join(_COMPONENTS)}"
        )
    return found


def _inputs(volume: SparseVolume, points: "wp.array") -> list[Any]:
    import warp as wp

    transform = volume.info.transform
    to_index = np.linalg.inv(transform[:3, :3])
    handle = wp.uint64(volume.id(points.device))
    return [handle, points, wp.vec3d(*transform[:3, 3].tolist()), wp.mat33d(*to_index.ravel().tolist())]


def _view(out: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """The same contiguous memory as another type and shape."""
    import warp as wp

    view: Any = wp.array(ptr=out.ptr, dtype=dtype, shape=shape, device=out.device)
    view._geokit_source = out  # the view does not own the memory it points to
    return view
