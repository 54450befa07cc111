"""Values and gradients of a sparse volume at any world points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geokit.core import launcher
from geokit.core.user_arrays import read_vectors
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.types import COMPONENTS, INDEX_TYPES
from geokit.volume.sampling.space import query_inputs, require_space
from geokit.volume.sampling.trilinear_table import gradient_linear, sample_linear

if TYPE_CHECKING:
    import warp as wp

__all__ = ["gradient", "is_scalar", "require_order", "sample", "view_as"]

ORDERS = {0: "nearest voxel", 1: "trilinear", 2: "triquadratic", 3: "tricubic"}


def sample(
    volume: SparseVolume,
    points: Any,
    *,
    order: int | None = None,
    space: str = "world",
    channel: int | str | None = None,
    device: Any = None,
) -> Any:
    """Value of a volume at each point.

    Order 0 takes the voxel whose centre is nearest (halves round up in index space), order 1 interpolates the eight
    voxels around the point trilinearly. Order 2 is triquadratic: along each index axis the parabola through the voxel
    below the point and its two neighbours, as of OpenVDB's and NanoVDB's quadratic samplers; 27 voxels, continuous, and
    not the same if an axis is reversed. Order 3 is tricubic: Catmull-Rom splines, as of NanoVDB's tricubic sampler; 64
    voxels and a continuous gradient. On a smooth field the error of order 1 shrinks with the square of the voxel size,
    that of orders 2 and 3 with its cube (at most 0.065 and 0.047 times the third derivative, for each axis; order 3 by
    0.016 of it where it hardly changes within four voxels): they reproduce quadratic fields, and can overshoot the
    voxels' range by up to half of it.

    Every voxel counts with the tree's own value: outside the active voxels that is the tile's value or the background.
    Of a narrow band of half width w, order 1 sees nothing else up to about w - 1 voxels from the surface, orders 2 and
    3 next to nothing up to w - 2.5. Points whose index coordinates lie beyond int32, or within two voxels of its ends,
    get the background. In a staggered grid (three components) each component is taken where it is stored: at the centre
    of the voxel's face towards smaller indices along its own axis.

    All arithmetic is float64. World to index is ``inverse(linear) @ (point - translation)``: the position is off by a
    few times 2^-53 of the largest coordinate that takes part, and a linear field is reproduced to a few times 2^-53 of
    its values plus that (orders 2 and 3: some tens). Where all voxels are equal the result is their value exactly.
    int64 voxels beyond 2^53 are rounded to float64. A voxel that is not finite spoils the samples that it takes part
    in. Held by tests/volume/sampling/test_sample.py, tests/volume/sampling/test_orders.py,
    tests/volume/sampling/test_staggered.py, tests/volume/sampling/test_sample_property.py,
    tests/volume/sampling/test_orders_property.py and tests/volume/sampling/test_sample_stability.py.

    Waves of amplitude 1 are off by at most 1 % from a length of 24 (order 1), 12 (2) and 12 (3) voxels on; order 0 by
    10 % from 64 on. Up to 1e9 voxels from the origin values are those of a place at most 2e-6 voxel away. Held by
    tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: Any scalar or vector grid, or an index grid with channels.
        points: Query points [world], shape (N, 3).
        order: 0, 1, 2 or 3; None for the one that the volume was made for (``info.order``), else 1.
        space: What ``points`` are in: "world", or "index", where voxel centres lie at whole numbers.
        channel: Number or name of the channel of an index grid; None for its first. See from_channel.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Values in the container of ``points``, float64 (float32 where the points are): shape (N,) for scalar grids, bool
        and mask grids as 0 and 1, (N, 3) and (N, 4) for vector and colour grids. Integers keep their stored range.
    Raises:
        InputError: points is not (N, 3) or not finite, the order or space is not known, or there is no such channel.
        FileFormatError: The buffer is not a sound grid, or a channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid stores points, or indices without a channel, instead of values.
    Source:
        Keys, Cubic convolution interpolation (1981), for the cubic's weights (a = -1/2).
    Example:
        >>> from geokit.volume import load
        >>> torus = load("data/samples/torus.vdb")
        >>> [sample(torus, [[0.1, 0.2, 0.0]], order=order).shape for order in (0, 1, 2, 3)]
        [(1,), (1,), (1,), (1,)]
    """
    import warp as wp

    from geokit.volume.sampling.kernel_table import query_kernel

    order = require_order((volume.info.order or 1) if order is None else order)
    require_space(space)
    volume = _valued(volume, channel)
    components = _require_components(volume)
    target = launcher.resolve_device(device)
    if order == 1 and (answer := sample_linear(volume, points, space, target)) is not None:
        return answer
    batch = read_vectors(points, "points", target)
    dtype = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components]
    background = dtype(*np.atleast_1d(volume.info.background).astype(np.float64).tolist())
    out = wp.empty(len(batch), dtype=dtype, device=target)
    kernel, more = query_kernel("sample", order, components, _is_staggered(volume))
    inputs = [*query_inputs(volume, batch.array, space), background, *more]
    launcher.launch(kernel, len(batch), inputs, [out], target)
    return batch.to_caller(view_as(out, wp.float64, (len(batch), 4)) if components == 4 else out)


def gradient(
    volume: SparseVolume,
    points: Any,
    *,
    order: int | None = None,
    space: str = "world",
    channel: int | str | None = None,
    device: Any = None,
) -> Any:
    """Gradient of a volume at each point.

    Orders 1, 2 and 3 give the exact gradient of the interpolant of :func:`sample`. That of orders 1 and 2 jumps between
    cells, and at a cell's border it is that of the cell on the side of larger indices; that of order 3 is continuous.
    On a smooth field the error of order 1 shrinks with the voxel size, that of orders 2 and 3 with its square. Order 0
    takes central differences of the voxels beside the nearest one: constant around each voxel, and of second order at
    voxel centres. All are computed along the index axes in float64 and brought to world space by the inverse transpose
    of the transform, so that rotated, sheared and non-uniform voxels give world gradients. Constant regions, and points
    beyond int32, give exactly 0.

    As normals of a level set, on a sphere with a radius of 30 voxels and half width 3, orders 1, 2 and 3 are off by
    0.65, 0.011 and 0.006 degrees rms at the surface, by 0.65, 0.05 and 0.01 up to one voxel from it, and by 0.65, 0.74
    and 0.35 up to two. Held by tests/volume/sampling/test_level_set_derivatives_stability.py,
    tests/volume/sampling/test_sample.py, tests/volume/sampling/test_orders.py, tests/volume/sampling/test_staggered.py
    and tests/volume/sampling/test_orders_property.py.

    Args:
        volume: Any scalar or vector grid, or an index grid with channels.
        points: Query points [world], shape (N, 3).
        order: 0, 1, 2 or 3; None for the one that the volume was made for (``info.order``), else 1.
        space: What ``points`` are in, and the gradients are along: "world", or "index", where voxel centres lie at
            whole numbers.
        channel: Number or name of the channel of an index grid; None for its first. See from_channel.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Gradients [value / world] in the container of ``points``, float64 (float32 where the points are): shape (N, 3)
        for scalar grids; for grids of C components the Jacobian, shape (N, C, 3), last axis the world axis.
    Raises:
        InputError: points is not (N, 3) or not finite, the order or space is not known, or there is no such channel.
        FileFormatError: The buffer is not a sound grid, or a channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid stores points, or indices without a channel, instead of values.
    """
    import warp as wp

    from geokit.volume.sampling.kernel_table import query_kernel

    order = require_order((volume.info.order or 1) if order is None else order)
    require_space(space)
    volume = _valued(volume, channel)
    components = _require_components(volume)
    target = launcher.resolve_device(device)
    if order == 1 and (answer := gradient_linear(volume, points, space, target)) is not None:
        return answer
    batch = read_vectors(points, "points", target)
    count = len(batch)
    out = wp.empty((count, components, 3), dtype=wp.float64, device=target)
    zero = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components](0.0)
    kernel, more = query_kernel("gradient", order, components, _is_staggered(volume))
    inputs = [*query_inputs(volume, batch.array, space), zero, *more]
    launcher.launch(kernel, count, inputs, [out], target)
    return batch.to_caller(view_as(out, wp.vec3d, (count,)) if components == 1 else out)


def is_scalar(volume: SparseVolume) -> bool:
    """Whether voxels are single numbers."""
    return COMPONENTS.get(volume.info.grid_type) == 1


def _is_staggered(volume: SparseVolume) -> bool:
    return volume.info.grid_class == "staggered" and COMPONENTS[volume.info.grid_type] == 3


def _valued(volume: SparseVolume, channel: int | str | None) -> SparseVolume:
    """The volume, or where it is an index grid the one that a channel makes of it."""
    if channel is None and volume.info.grid_type not in INDEX_TYPES:
        return volume
    from geokit.volume._from_channel import from_channel

    return from_channel(volume, 0 if channel is None else channel)


def require_order(order: Any, lowest: int = 0) -> int:
    """The order of an interpolant as an int.

    Raises:
        InputError: It is not one of those from ``lowest`` on.
    """
    allowed = {number: name for number, name in ORDERS.items() if number >= lowest}
    if isinstance(order, bool) or not isinstance(order, (int, np.integer)) or int(order) not in allowed:
        known = ", ".join(f"{number} ({name})" for number, name in allowed.items())
        raise InputError(f"order: {order!r} is not supported; use one of {known}")
    return int(order)


def _require_components(volume: SparseVolume) -> int:
    found = COMPONENTS.get(volume.info.grid_type)
    if found is None:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} stores no values that can be "
            f"interpolated; convert it to one of {', '.join(COMPONENTS)}"
        )
    return found


def view_as(out: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """The same contiguous memory as another type and shape."""
    import warp as wp

    view: Any = wp.array(ptr=out.ptr, dtype=dtype, shape=shape, device=out.device)
    view._geokit_source = out  # the view does not own the memory it points to
    return view
