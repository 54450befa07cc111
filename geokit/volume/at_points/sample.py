"""Values and gradients of a sparse volume at arbitrary world points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.base.query import FIRST_ALONE
from geokit.core.interop.types import Array, Devices, Rows
from geokit.core.interop.user_arrays import read_vectors
from geokit.core.memory.struct_array import handed_out
from geokit.core.query.ask import query
from geokit.core.require import described, whole_number
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.types import COMPONENTS, INDEX_TYPES
from geokit.volume.retyped.from_channel import from_channel
from geokit.volume.sampling.leaf_table import leaf_table
from geokit.volume.sampling.space import query_inputs, require_space, world_to_index
from geokit.volume.sampling.trilinear_table import gradient_linear, sample_linear
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    from geokit.volume.at_points.user_kernels import SparseVolume as InKernels

# A kernel may ask any number of points: the table that saves each of them some time is made at once.
MANY = 1 << 40
ORDERS = {0: "nearest voxel", 1: "trilinear", 2: "triquadratic", 3: "tricubic"}


def _require_placeable(volume: Any, *, space: str = "world", channel: int | str | None = None, **_: Any) -> None:
    """Refuse what a transform has no meaning for: points of the index space, and values that may have to turn."""
    require_space(space)
    if space != "world":
        raise InputError("space: index coordinates move with the volume; beside transform give world points")
    values = _valued(require_volume(volume, "volume"), channel).info.grid_type
    if COMPONENTS.get(values, 1) != 1:
        raise InputError(
            f"transform: vectors of type {values} may have to turn too; move the points, and turn the values"
        )


# Points take less time than their copies to another device, at any order.
@query(
    "points",
    places=_require_placeable,
    gradient="..sampling.gradients:SAMPLE",
    is_replayed=True,
    least_rows=FIRST_ALONE,
    row_bytes=16,
)
def sample(
    volume: SparseVolume,
    points: Rows,
    *,
    order: int | None = None,
    space: str = "world",
    channel: int | str | None = None,
    transform: ArrayLike | None = None,
    device: Devices = None,
) -> Array:
    """Interpolate a volume at each point.

    Order 0 takes the voxel with the nearest center (halves round up in index space). Order 1 interpolates the eight
    voxels around the point trilinearly. Order 2 is triquadratic: 27 voxels, continuous, and not symmetric under
    reversal of an axis. Order 3 is tricubic (Catmull-Rom): 64 voxels and a continuous gradient. On a smooth field the
    error shrinks with the square of the voxel size at order 1 and with its cube at orders 2 and 3, which reproduce
    quadratic fields and can overshoot the range of the voxels by up to half of it.

    Every voxel counts with its value in the tree; outside the active voxels that is the tile's value or the background.
    Points whose index coordinates lie beyond int32, or within two voxels of its ends, get the background. A staggered
    grid (three components) has each component sampled at its own location: the center of the voxel's face towards
    smaller indices along the component's axis.

    All arithmetic is float64. The index position is off by a few times 2^-53 of the largest coordinate involved. A
    linear field is reproduced to a few times 2^-53 of its values (orders 2 and 3: some tens) plus the effect of that.
    Where all voxels are equal the result is exactly their value. int64 voxels beyond 2^53 are rounded to float64. A
    voxel that is not finite spoils all samples that use it. docs/design/sampling.md derives the errors, also near the
    end of a narrow band.

    Waves of amplitude 1 are off by at most 1 % from a length of 24 (order 1), 12 (order 2) and 12 voxels (order 3) on,
    at order 0 by 10 % from 64 on. Up to 1e9 voxels from the origin, values are those of a place at most 2e-6 voxel
    away.

    Args:
        volume: Any scalar or vector grid, or an index grid with channels.
        points: Query points [world], shape (N, 3).
        order: 0, 1, 2 or 3; None for the order for which the volume was made (``info.order``), else 1.
        space: Space of ``points``: "world", or "index", where voxel centers lie at whole numbers.
        channel: Number or name of the channel of an index grid; None for its first. See :func:`from_channel`.
        transform: Where it is: a rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...),
            beside scalar grids and world points. All is in world coordinates; moving rounds by 1e-15 of the size. None
            leaves the volume in place.
        device: Where to compute; None for the first GPU, else the CPU. The first of several devices answers.
    Returns:
        Values in the container of ``points``, float64 (float32 if the points are): shape (N,) for scalar grids, bool
            and mask grids as 0 and 1, (N, 3) and (N, 4) for vector and color grids. Integers keep their stored range.
    Raises:
        InputError: points is not (N, 3) or not finite, the order or space is unknown, there is no such channel, or the
            transform is not rigid (to 1e-6) or is given beside tensors with gradients, vectors or index coordinates.
        FileFormatError: The buffer is not a valid grid, or a channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid stores points, or indices without a channel, instead of values.
    Source:
        Keys, Cubic convolution interpolation (1981), for the cubic's weights (a = -1/2).
    Example:
        >>> from geokit.volume import load
        >>> torus = load("data/samples/torus.vdb")
        >>> [sample(torus, [[0.1, 0.2, 0.0]], order=order).shape for order in (0, 1, 2, 3)]
        [(1,), (1,), (1,), (1,)]
    """
    from geokit.volume.sampling.kernel_table import query_kernel

    volume, order, components, target = _checked(volume, order, space, channel, device)
    if order == 1 and (answer := sample_linear(volume, points, space, target)) is not None:
        return answer
    batch = read_vectors(points, "points", target, single=True)
    dtype = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components]
    background = dtype(*np.atleast_1d(volume.info.background).astype(np.float64).tolist())
    out = wp.empty(len(batch), dtype=dtype, device=target)
    kernel, more = query_kernel("sample", order, components, _is_staggered(volume))
    inputs = [*query_inputs(volume, batch.array, space), background, *more]
    launcher.launch(kernel, len(batch), inputs, [out], target)
    return batch.to_caller(view_as(out, wp.float64, (len(batch), 4)) if components == 4 else out)


# Points take less time than their copies to another device, at any order.
@query(
    "points",
    is_turned=True,
    places=_require_placeable,
    gradient="..sampling.gradients:GRADIENT",
    is_replayed=True,
    least_rows=FIRST_ALONE,
    row_bytes=32,
)
def gradient(
    volume: SparseVolume,
    points: Rows,
    *,
    order: int | None = None,
    space: str = "world",
    channel: int | str | None = None,
    transform: ArrayLike | None = None,
    device: Devices = None,
) -> Array:
    """Gradient of a volume at each point.

    Orders 1, 2 and 3 give the exact gradient of the interpolant of :func:`sample`. At orders 1 and 2 it jumps between
    cells, and on a cell's border it belongs to the cell on the side of larger indices; at order 3 it is continuous. On
    a smooth field the error shrinks with the voxel size at order 1 and with its square at orders 2 and 3. Order 0 takes
    central differences of the voxels beside the nearest one: constant around each voxel, and of second order at voxel
    centers. All gradients are computed along the index axes in float64 and transformed to world space by the inverse
    transpose of the transform, so that rotated, sheared and non-uniform voxels give world gradients. Constant regions,
    and points beyond int32, give exactly 0.

    Errors as normals of a level set, on a sphere with a radius of 30 voxels and half width 3, at orders 1, 2 and 3:
    0.65, 0.011 and 0.006 degrees rms at the surface, 0.65, 0.05 and 0.01 up to one voxel from it, and 0.65, 0.74 and
    0.35 up to two.

    Args:
        volume: Any scalar or vector grid, or an index grid with channels.
        points: Query points [world], shape (N, 3).
        order: 0, 1, 2 or 3; None for the order for which the volume was made (``info.order``), else 1.
        space: Space of ``points`` and of the gradients: "world", or "index", where voxel centers lie at whole numbers.
        channel: Number or name of the channel of an index grid; None for its first. See :func:`from_channel`.
        transform: Where it is: a rigid map or mirror for column vectors, (4, 4), or (B, 4, 4) for answers (B, N, ...),
            beside scalar grids and world points. All is in world coordinates; moving rounds by 1e-15 of the size. None
            leaves the volume in place.
        device: Where to compute; None for the first GPU, else the CPU. The first of several devices answers.
    Returns:
        Gradients [value / world] in the container of ``points``, float64 (float32 where the points are): shape (N, 3)
        for scalar grids; for grids of C components the Jacobian, shape (N, C, 3), last axis the world axis.
    Raises:
        InputError: points is not (N, 3) or not finite, the order or space is unknown, there is no such channel, or the
            transform is not rigid (to 1e-6) or is given beside tensors with gradients, vectors or index coordinates.
        FileFormatError: The buffer is not a valid grid, or a channel has fewer values than the grid has indices.
        UnsupportedGridError: The grid stores points, or indices without a channel, instead of values.
    """
    from geokit.volume.sampling.kernel_table import query_kernel

    volume, order, components, target = _checked(volume, order, space, channel, device)
    if order == 1 and (answer := gradient_linear(volume, points, space, target)) is not None:
        return answer
    batch = read_vectors(points, "points", target, single=True)
    count = len(batch)
    out = wp.empty((count, components, 3), dtype=wp.float64, device=target)
    zero = {1: wp.float64, 3: wp.vec3d, 4: wp.vec4d}[components](0.0)
    kernel, more = query_kernel("gradient", order, components, _is_staggered(volume))
    inputs = [*query_inputs(volume, batch.array, space), zero, *more]
    launcher.launch(kernel, count, inputs, [out], target)
    return batch.to_caller(view_as(out, wp.vec3d, (count,)) if components == 1 else out)


def on_kernel(volume: SparseVolume, device: Any) -> InKernels:
    """:meth:`geokit.volume.SparseVolume.on_kernel`."""
    from geokit.volume.at_points.user_kernels import SparseVolume as InKernels

    volume, _, components, target = _checked(volume, 1, "world", None, device)
    if components != 1:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} does not hold numbers, which kernels "
            "sample; use volume.sample, or a volume of one component"
        )
    found: Any = InKernels()
    found.grid = wp.uint64(volume.id(target))
    table = leaf_table(volume, target, MANY)
    if table is not None:
        found.table = table
    found.origin, found.to_index = world_to_index(volume)
    found.background = wp.float64(volume.info.background)
    return handed_out(found, target, volume)


def _checked(volume: Any, order: Any, space: Any, channel: Any, device: Any) -> tuple[SparseVolume, int, int, Any]:
    """The volume whose values are asked for, the order, the number of components, and the device."""
    require_volume(volume, "volume")
    order = require_order((volume.info.order or 1) if order is None else order)
    require_space(space)
    volume = _valued(volume, channel)
    return volume, order, _require_components(volume), launcher.resolve_device(device)


def is_scalar(volume: SparseVolume) -> bool:
    """Whether voxels are single numbers."""
    return COMPONENTS.get(volume.info.grid_type) == 1


def _is_staggered(volume: SparseVolume) -> bool:
    return volume.info.grid_class == "staggered" and COMPONENTS[volume.info.grid_type] == 3


def _valued(volume: SparseVolume, channel: int | str | None) -> SparseVolume:
    """The volume itself, or for an index grid the volume of values of one channel."""
    if channel is None and volume.info.grid_type not in INDEX_TYPES:
        return volume
    return from_channel(volume, 0 if channel is None else channel)


def require_order(order: Any, lowest: int = 0) -> int:
    """The order of an interpolant as an int.

    Raises:
        InputError: It is not an order from ``lowest`` on.
    """
    allowed = {number: name for number, name in ORDERS.items() if number >= lowest}
    number = whole_number(order)
    if number not in allowed:
        known = ", ".join(f"{number} ({name})" for number, name in allowed.items())
        raise InputError(f"order: {described(order)} is not supported; use one of {known}")
    return number


def _require_components(volume: SparseVolume) -> int:
    found = COMPONENTS.get(volume.info.grid_type)
    if found is None:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} of type {volume.info.grid_type} stores no values that can be "
            f"interpolated; convert it to one of {', '.join(COMPONENTS)}"
        )
    return found


def view_as(out: "wp.array", dtype: Any, shape: tuple[int, ...]) -> "wp.array":
    """View the same contiguous memory as another type and shape."""
    view: Any = wp.array(ptr=out.ptr, dtype=dtype, shape=shape, device=out.device)
    view._geokit_source = out  # the view does not own the memory it points to
    return view
