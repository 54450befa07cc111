"""Resampling of volumes to another voxel size or transform."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geokit.core import launcher
from geokit.core.base.late_warp import wp
from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.types import Device
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.memory.row_products import row_product
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.at_points.active import active_at
from geokit.volume.at_points.sample import require_order, sample
from geokit.volume.level_set.band_widths import BandWidths, widths_of, with_widths
from geokit.volume.level_set.operands import require_level_set, with_band
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.header import checked_transform, voxel_size_of
from geokit.volume.nanovdb.layout import LEAF_VOXELS
from geokit.volume.nanovdb.types import QUANTIZED
from geokit.volume.sampling.resample_leaves import filled_leaves, target_leaves, way_between
from geokit.volume.sampling.space import query_inputs
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import (
    CUBE_TOLERANCE,
    Leaves,
    assemble,
    is_cubic,
    leaves_of,
    require_volume,
    uniform_voxel_size,
    voxelized,
)
from geokit.volume.tree.typed_tree import VALUE_TYPES, tree_of, tree_of_leaves, voxelized_tree
from geokit.volume.tree.typed_writer import rebuilt

TYPES = ("float", "double", "vec3f", "vec3d")
# Memory of a target leaf during construction: values and masks, their copy in node order, and that in the buffer.
BYTES_PER_LEAF = 3 * 2144
# Source voxels by which a level set's band must exceed that of the target: the reach of the trilinear stencil.
STENCIL = 2.0
# Widest band [source voxels] that is computed to fill the band of a coarser target.
WIDEST_BAND = 512.0


def _bytes(volume: SparseVolume, *, voxel_size: float | None = None, transform: Any = None, **_: Any) -> float:
    def edge(matrix: Any) -> float:
        return float(abs(np.linalg.det(np.asarray(matrix, np.float64)[:3, :3])) ** (1.0 / 3.0))

    ratio = edge(volume.info.transform) / (edge(transform) if voxel_size is None else voxel_size)
    # A band keeps its width in voxels.
    return 19500 * leaf_count(volume) * ratio ** (2 if volume.info.grid_class == "level set" else 3)


@of_constants
@needs(_bytes, late=True)
def resample(
    volume: SparseVolume,
    *,
    voxel_size: float | None = None,
    transform: Any = None,
    order: int = 1,
    device: Device = None,
) -> SparseVolume:
    """Resample a volume to voxels of another size, or to another transform.

    The value of a voxel is the volume's sample at its center (:func:`geokit.volume.sample`, in float64, rounded once);
    inside the active region a linear field is reproduced to that rounding. A voxel is active if the nearest voxel of
    the source is; all others get the background. Level sets keep the widths of their band in voxels: their background
    follows the voxel size and their values stay distances [world]. Where the new band is wider than the old one,
    distances are first computed beyond the old one (:func:`geokit.volume.renormalize`), which needs cubic source
    voxels.

    Labels, masks, integers and all other types that are not interpolated require order 0: the stored value of the
    nearest voxel, halves rounded up in index space. Needs no OpenVDB.

    Args:
        volume: Float, double, vec3f or vec3d grid; quantized ones become float. With order 0, any grid that holds
            values. The components of vectors are not rotated with the voxels.
        voxel_size: New edge length [world]. Voxels become cubes, along the same axes if these are orthogonal, else
            along the world's. The center of voxel (0, 0, 0) stays in place.
        transform: Alternative to ``voxel_size``: index to world, shape (4, 4).
        order: Order of interpolation, as for ``sample``.
        device: Where to compute; None for the first GPU, else the CPU.
    Returns:
        Volume of the same type, class, name and metadata.
    Raises:
        InputError: Not exactly one of voxel_size and transform is given, no grid can have it, the order is unknown, or
            there are too many voxels to be numbered.
        UnsupportedGridError: The grid holds no values, or its type is not interpolated and the order is not 0.
        DeviceMemoryError: The result does not fit into memory.
    """
    require_volume(volume, "volume")
    order, grid_type = require_order(order), volume.info.grid_type
    interpolated = grid_type in (*TYPES, *QUANTIZED)
    if order > 0 and not interpolated and grid_type in VALUE_TYPES:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} is of type {grid_type}, and only {', '.join(TYPES)} grids are "
            "interpolated; use order=0, which takes the nearest voxel"
        )
    require_volume(volume, "volume", VALUE_TYPES)
    if (voxel_size is None) == (transform is None):
        raise InputError("voxel_size, transform: give one of the two")
    if voxel_size is not None:
        target = _scaled(volume.info.transform, require_finite_scalar(voxel_size, "voxel_size", low=0.0))
    else:
        target = checked_transform(transform)
    if not interpolated:
        return _resampled_nearest(volume, target, device)
    dtype = np.float64 if grid_type in ("double", "vec3d") else np.float32
    return resampled(volume, target, order=order, dtype=dtype, device=device)


def resampled(
    volume: SparseVolume, transform: NDArray[np.float64], *, order: int, dtype: Any, device: Device = None
) -> SparseVolume:
    """:func:`resample` for checked arguments and any real value type."""
    if volume.info.grid_class != "level set":
        return _sampled(voxelized(volume), transform, order, dtype, volume.info.background, None, device)
    band = _band(volume, transform)
    source = voxelized(band.source)
    background = band.known.widest * band.voxel_size
    result = _sampled(source, transform, order, dtype, background, background, device)
    result = with_widths(result, band.voxel_size, band.known)
    if band.known == band.widths:
        return result
    voxel_size = uniform_voxel_size(result, "volume")
    return with_widths(with_band(result, voxel_size, band.widths.widest), voxel_size, band.widths)


class _Band(NamedTuple):
    source: SparseVolume
    voxel_size: float
    known: BandWidths
    widths: BandWidths


def _band(volume: SparseVolume, transform: NDArray[np.float64]) -> _Band:
    """A source whose band reaches as far as the target's, the target's voxel size, and widths [its voxels]."""
    old = float(np.cbrt(np.prod(volume.info.voxel_size)))
    new = float(np.cbrt(np.prod(voxel_size_of(transform))))
    if not is_cubic(volume.info.transform):
        # Distances beyond the band need cubes: those missing are computed on the target's voxels if these are cubes.
        widths = widths_of(volume, old)
        known = BandWidths(*(min(width, width * old / new) for width in widths))
        if is_cubic(transform) and widths.widest > WIDEST_BAND:
            raise InputError(
                f"volume: its band is {widths.widest:.3g} voxels wide, of the mean size {old:.3g}, too much to be made "
                "of cubes; give a transform with voxels of the same proportions"
            )
        return _Band(volume, new, known, widths if is_cubic(transform) else known)
    old = require_level_set(volume, "volume")
    widths = widths_of(volume, old)
    needed = widths.widest * new / old + STENCIL
    # Also for equal voxels: at the end of the band the stencil would read the background as a distance.
    if needed > widths.narrowest:
        if needed > WIDEST_BAND:
            raise InputError(
                f"voxel_size: {new:g} is {new / old:.3g} times the old one, too much at a time; resample at "
                f"{old * WIDEST_BAND / 2 / widths.widest:.2g} first"
            )
        volume = with_band(volume, old, needed)
    return _Band(volume, new, widths, widths)


def _scaled(transform: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Cubes of another size that share the center of voxel (0, 0, 0)."""
    target = np.array(transform)
    axes = transform[:3, :3] / voxel_size_of(transform)
    is_orthogonal = np.allclose(axes.T @ axes, np.eye(3), rtol=0.0, atol=CUBE_TOLERANCE)
    target[:3, :3] = axes * voxel_size if is_orthogonal else np.eye(3) * voxel_size
    return target


def _sampled(
    source: SparseVolume,
    transform: NDArray[np.float64],
    order: int,
    dtype: Any,
    background: Any,
    band: float | None,
    device: Any,
) -> SparseVolume:
    """Sample ``source`` at the voxels of another transform; level sets only within ``band`` of the surface."""
    outside = np.asarray(background, dtype)

    def read(voxels: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        points = row_product(voxels, transform[:3, :3].T, transform[:3, 3])
        sampled = np.asarray(sample(source, points, order=order, device=device)).astype(dtype)
        active = np.asarray(active_at(source, points, device=device))
        if band is not None:
            active &= np.abs(sampled) < outside
            return np.where(active, sampled, np.copysign(outside, sampled)), active
        return np.where(active.reshape(-1, *[1] * (sampled.ndim - 1)), sampled, outside), active

    leaves = leaves_of(source)
    used = leaves.origins[leaves.masks.any(axis=1)]
    origins = target_leaves(used, source.info.transform, transform, BYTES_PER_LEAF)
    origins, masks, values = filled_leaves(origins, np.dtype((dtype, outside.shape)), read)
    return assemble(
        Leaves(origins, masks),
        values,
        source,
        background=background,
        grid_class=source.info.grid_class,
        transform=transform,
    )


def _resampled_nearest(volume: SparseVolume, transform: NDArray[np.float64], device: Any) -> SparseVolume:
    """Resample a volume of one of VALUE_TYPES by nearest voxel; type, name, class, background and metadata stay.

    Raises:
        InputError: Indices of the result exceed int32.
        DeviceMemoryError: The result, or the voxels in the volume's tiles, do not fit into memory.
    """
    tree = tree_of(volume)
    layout, background = tree.layout, tree.background
    leaves = voxelized_tree(tree, volume.info.name)
    used = leaves.origins[leaves.masks.any(axis=1)]
    per_leaf = LEAF_VOXELS * layout.background.itemsize + layout.leaf_size + 256
    origins = target_leaves(used, volume.info.transform, transform, per_leaf)
    linear, shift = way_between(transform, volume.info.transform)

    def read(voxels: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        # Directly from index to index: a detour through world space would round exact halves to either side.
        points = row_product(voxels, linear.T, shift)
        active = np.asarray(active_at(volume, points, space="index", device=device))
        values = _values_at(volume, points, device).astype(layout.background.base)
        values[~active] = background
        return values, active

    made = tree_of_leaves(layout, background, *filled_leaves(origins, layout.background, read))
    return rebuilt(made, volume, transform)


def _values_at(volume: SparseVolume, points: NDArray[np.float64], device: Any) -> NDArray[Any]:
    """Values of the voxels nearest to index coordinates, exact."""
    if volume.info.grid_type != "int64":
        return np.asarray(sample(volume, points, order=0, space="index", device=device))
    from geokit.volume.sampling.active_kernels import nearest_int64_kernel

    target = launcher.resolve_device(device)
    given = wp.array(points, dtype=wp.vec3d, device=target)
    out = wp.empty(len(points), dtype=wp.int64, device=target)
    inputs = [*query_inputs(volume, given, "index"), wp.int64(volume.info.background)]
    launcher.launch(nearest_int64_kernel, len(points), inputs, [out], target)
    return np.asarray(out.numpy())
