"""Constructive solid geometry of level sets, and of masks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geokit.core.user_arrays import require_finite_scalar
from geokit.errors import InputError
from geokit.volume._model import SparseVolume
from geokit.volume.level_set.operands import half_width_of, require_level_set, with_band
from geokit.volume.level_set.redistance import redistance
from geokit.volume.tree.mask_csg import combined_masks
from geokit.volume.tree.openvdb_call import call_openvdb

__all__ = ["difference", "intersection", "union"]

# Voxels that a smooth blend may be wide: its bands are as wide, and memory goes with them.
WIDEST_BLEND = 256.0
# Voxels between the blend's reach and the end of the bands that it is made from.
BLEND_MARGIN = 1.0


def union(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """What is inside one of several level sets.

    Per voxel the minimum of the distances: exact outside the result, and inside it the distance to the nearest operand
    surface, which near a seam is nearer than the result's. With ``smooth`` the seam is filled by the quadratic smooth
    minimum, whose blend ends where the distances differ by that width, and distances are made new from the result's
    surface (:func:`geokit.volume.renormalize`).

    All operands are brought to the first one's grid: another voxel size or transform by trilinear interpolation
    (:func:`geokit.volume.resample`), another band width by dropping voxels or by computing distances beyond the band;
    another value type is converted. Held by tests/volume/test_csg.py.

    Of mask grids, all on one lattice, the voxels that are on in one of them; needs no OpenVDB. Held by
    tests/volume/tree/test_mask_csg.py.

    Args:
        a: Level set, or mask; the result has its grid, band, name and metadata.
        b: Another of the kind.
        more: More of them.
        smooth: Width of the blend [world]; 0 keeps the sharp seam. Of masks 0.
    Returns:
        Level set of ``a``'s type (float where that is quantised), or mask.
    Raises:
        InputError: An operand is no level set or its voxels are no cubes; smooth is negative, not finite, or more than
            256 voxels; masks whose voxels are not the same.
        UnsupportedGridError: Values that are not real numbers, or a mask beside a grid that is none.
        DeviceMemoryError: The tiles of masks hold more voxels than there is memory for.
        MissingDependencyError: geokit was built without OpenVDB.
    Source:
        Museth et al., "Level set surface editing operators" (2002), as in OpenVDB's csgUnion; smooth minimum: Quilez.
    """
    return _combined("union", (a, b, *more), smooth)


def intersection(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """What is inside all of several level sets.

    Per voxel the maximum of the distances: exact inside the result, and outside it the distance to the farthest
    operand, which is less than the distance to the result near its edges. Of masks the voxels that are on in all of
    them. Everything else as in :func:`union`.

    Args:
        a: Level set, or mask; the result has its grid, band, name and metadata.
        b: Another of the kind.
        more: More of them.
        smooth: Width over which edges are rounded [world]; 0 keeps them.
    Returns:
        Level set of ``a``'s type, or mask.
    Raises:
        InputError: As of :func:`union`.
        UnsupportedGridError: As of :func:`union`.
        DeviceMemoryError: As of :func:`union`.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    return _combined("intersection", (a, b, *more), smooth)


def difference(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """What is inside the first level set and outside all others.

    Per voxel the maximum of ``a`` and ``-b``; of masks the voxels that are on in ``a`` alone. Everything else as in
    :func:`intersection`.

    Args:
        a: Level set, or mask, from which the others are taken; the result has its grid, band, name and metadata.
        b: Another of the kind.
        more: More of them.
        smooth: Width over which edges are rounded [world]; 0 keeps them.
    Returns:
        Level set of ``a``'s type, or mask.
    Raises:
        InputError: As of :func:`union`.
        UnsupportedGridError: As of :func:`union`.
        DeviceMemoryError: As of :func:`union`.
        MissingDependencyError: geokit was built without OpenVDB.
    """
    return _combined("difference", (a, b, *more), smooth)


def _combined(kind: str, operands: tuple[SparseVolume, ...], smooth: float) -> SparseVolume:
    names = ["a", "b", *(f"more[{i}]" for i in range(len(operands) - 2))]
    if isinstance(operands[0], SparseVolume) and operands[0].info.grid_type == "mask":
        if require_finite_scalar(smooth, "smooth") != 0.0:
            raise InputError(f"smooth: {smooth} is for level sets; voxels of masks are on or off")
        return combined_masks(kind, operands, names)
    from geokit.native import operations

    sizes = [require_level_set(volume, name) for volume, name in zip(operands, names, strict=True)]
    first, voxel_size = operands[0], sizes[0]
    blend = _checked_blend(smooth, voxel_size)
    half_width = half_width_of(first, voxel_size)
    # A blend of this width lowers the minimum by a quarter of it: to know the result in its band, the operands must be
    # known that much farther, and where they differ by the whole width.
    reach = half_width + BLEND_MARGIN + 1.25 * blend / voxel_size if blend else half_width
    result = with_band(first, voxel_size, reach)
    for number, volume in enumerate(operands[1:], start=2):
        other = with_band(_on_grid_of(volume, first), voxel_size, reach)
        if blend:
            # The blend is a distance only away from the seam; the next operand needs one in a wide band.
            blended = call_openvdb(operations.smooth_csg, result, other, kind=kind, blend=blend)
            width = half_width if number == len(operands) else reach
            result = redistance(blended, voxel_size, width)
        else:
            result = call_openvdb(operations.csg, result, other, kind=kind)
    return with_band(result, voxel_size, half_width)


def _checked_blend(smooth: Any, voxel_size: float) -> float:
    blend = require_finite_scalar(smooth, "smooth")
    if blend < 0.0:
        raise InputError(f"smooth: {blend} is negative; give the width of the blend, or 0 for none")
    if blend > WIDEST_BLEND * voxel_size:
        raise InputError(
            f"smooth: {blend:g} is {blend / voxel_size:.3g} voxels, more than {WIDEST_BLEND:g}; resample the operands "
            f"at a voxel_size of {blend / WIDEST_BLEND:.2g} or more"
        )
    return blend


def _on_grid_of(volume: SparseVolume, target: SparseVolume) -> SparseVolume:
    """The level set on the lattice of ``target``, with values of its type."""
    wanted = target.info.transform
    types = {_real_type(volume), _real_type(target)}
    scale = float(np.abs(wanted[:3, :3]).max())
    same = np.allclose(volume.info.transform, wanted, rtol=0.0, atol=math.ulp(scale) * 8)
    if same and len(types) == 1:
        return volume
    from geokit.volume._resample import resampled

    return resampled(volume, wanted, order=1, dtype=np.float64 if _real_type(target) == "double" else np.float32)


def _real_type(volume: SparseVolume) -> str:
    return "double" if volume.info.grid_type == "double" else "float"
