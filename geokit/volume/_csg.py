"""Constructive solid geometry of level sets and of masks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geokit.core.gradients.differentiable import of_constants
from geokit.core.interop.user_arrays import require_finite_scalar
from geokit.core.memory.needs import needs
from geokit.core.require import require_one_world
from geokit.errors import InputError
from geokit.volume.level_set.band_widths import widths_of, with_widths
from geokit.volume.level_set.false_walls import without_false_walls
from geokit.volume.level_set.operands import require_level_set, with_band
from geokit.volume.level_set.redistance import redistance
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.nodes import bits_of
from geokit.volume.nanovdb.provenance import with_more, world_metadata
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.openvdb_call import call_openvdb
from geokit.volume.tree.typed_tree import RowTable, tree_of, tree_of_leaves, voxelized_tree
from geokit.volume.tree.typed_writer import rebuilt

# Largest width of a smooth blend [voxels]: the bands must be as wide, and memory grows with them.
WIDEST_BLEND = 256.0
# Voxels between the reach of the blend and the end of the bands from which it is computed.
BLEND_MARGIN = 1.0
# Factors of both operands and of the result with which each operation is a union.
UNIONS = {"union": (1.0, 1.0, 1.0), "intersection": (-1.0, -1.0, -1.0), "difference": (-1.0, 1.0, -1.0)}


@of_constants
@needs(lambda a, b, *more, **_: 4700 * sum(map(leaf_count, (a, b, *more))), fatal=True)
def union(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """Union of level sets, or of masks: the region inside at least one of them.

    Each voxel takes the minimum of the distances. That is exact outside the result. Inside it is the distance to the
    nearest operand surface, which near a seam is nearer than the surface of the result. Where surfaces of operands
    touch back to back, or overlap by less than two voxels, that would be a wall: there depths are those from the
    result's isosurface, right to 0.8 voxel; gaps under 0.01 voxel count as touching. With ``smooth`` the seam is
    filled by the quadratic smooth minimum, whose blend ends where the distances differ by that width; the distances are
    then recomputed from the result's surface (:func:`geokit.volume.renormalize`).

    All operands are converted to the first one's grid: another voxel size or transform by trilinear interpolation
    (:func:`geokit.volume.resample`), another band width by dropping voxels or by computing distances beyond the band,
    another value type by conversion.

    The union of mask grids, all on one lattice, is the set of voxels that are on in at least one of them. It needs no
    OpenVDB.

    Args:
        a: Level set or mask. The result takes its grid, band, name and metadata, and the unit and up axis
            that any of them says.
        b: Second operand, of the same kind.
        more: Further operands.
        smooth: Width of the blend [world]; 0 keeps the sharp seam. Must be 0 for masks.
    Returns:
        Level set of ``a``'s type (float if that is quantized), or mask.
    Raises:
        InputError: An operand is no level set or has voxels that are not cubes; smooth is negative, not finite, or more
            than 256 voxels; masks lie on different lattices; units or up axes are known and differ.
        UnsupportedGridError: Values are not real numbers, or masks are mixed with other grids.
        DeviceMemoryError: The tiles of masks hold more voxels than fit into memory.
        MissingDependencyError: Level sets, and geokit was built without OpenVDB.
    Source:
        Museth et al., "Level set surface editing operators" (2002), as in OpenVDB's csgUnion; smooth minimum: Quilez.
    """
    return _combined("union", (a, b, *more), smooth)


@of_constants
@needs(lambda a, b, *more, **_: 4700 * sum(map(leaf_count, (a, b, *more))), fatal=True)
def intersection(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """Intersection of level sets, or of masks: the region inside all of them.

    Each voxel takes the maximum of the distances. That is exact inside the result. Outside it is the distance to the
    farthest operand, which near the edges of the result is less than the distance to the result; where what the
    operands leave out touches, it is computed anew as in :func:`union`. The intersection of
    masks is the set of voxels that are on in all of them. Conversions and limits are those of :func:`union`.

    Args:
        a: Level set or mask. The result takes its grid, band, name and metadata, and the unit and up axis
            that any of them says.
        b: Second operand, of the same kind.
        more: Further operands.
        smooth: Width over which edges are rounded [world]; 0 keeps them. Must be 0 for masks.
    Returns:
        Level set of ``a``'s type, or mask.
    Raises:
        InputError, UnsupportedGridError, DeviceMemoryError: As for :func:`union`.
        MissingDependencyError: Level sets, and geokit was built without OpenVDB.
    """
    return _combined("intersection", (a, b, *more), smooth)


@of_constants
@needs(lambda a, b, *more, **_: 4700 * sum(map(leaf_count, (a, b, *more))), fatal=True)
def difference(a: SparseVolume, b: SparseVolume, *more: SparseVolume, smooth: float = 0.0) -> SparseVolume:
    """Difference of level sets, or of masks: the region inside the first and outside all others.

    Each voxel takes the maximum of ``a`` and ``-b``. The difference of masks is the set of voxels that are on in ``a``
    alone. Conversions and limits are those of :func:`union`; distances are exact where those of :func:`intersection`
    are.

    Args:
        a: Level set or mask from which the others are subtracted. The result takes its grid, band, name and metadata,
            and the unit and up axis that any of them says.
        b: Second operand, of the same kind.
        more: Further operands.
        smooth: Width over which edges are rounded [world]; 0 keeps them. Must be 0 for masks.
    Returns:
        Level set of ``a``'s type, or mask.
    Raises:
        InputError, UnsupportedGridError, DeviceMemoryError: As for :func:`union`.
        MissingDependencyError: Level sets, and geokit was built without OpenVDB.
    """
    return _combined("difference", (a, b, *more), smooth)


def _combined(kind: str, operands: tuple[SparseVolume, ...], smooth: float) -> SparseVolume:
    names = ["a", "b", *(f"more[{i}]" for i in range(len(operands) - 2))]
    said = require_one_world(
        **{name: require_volume(one, name).info for name, one in zip(names, operands, strict=True)}
    )
    if operands[0].info.grid_type == "mask":
        if require_finite_scalar(smooth, "smooth") != 0.0:
            raise InputError(f"smooth: {smooth} is for level sets; voxels of masks are on or off")
        return with_more(_combined_masks(kind, operands, names), world_metadata(**said))
    from geokit.native import operations

    sizes = [require_level_set(volume, name) for volume, name in zip(operands, names, strict=True)]
    first, voxel_size = operands[0], sizes[0]
    blend = require_finite_scalar(smooth, "smooth")
    if blend < 0.0:
        raise InputError(f"smooth: {blend} is negative; give the width of the blend, or 0 for none")
    if blend > WIDEST_BLEND * voxel_size:
        raise InputError(
            f"smooth: {blend:g} is {blend / voxel_size:.3g} voxels, more than {WIDEST_BLEND:g}; resample the operands "
            f"at a voxel_size of {blend / WIDEST_BLEND:.2g} or more"
        )
    widths = widths_of(first, voxel_size)
    half_width = widths.widest
    # A blend lowers the minimum by a quarter of its width, and acts where the operands differ by up to the whole width.
    # To know the result throughout its band, the operands must be known farther by both.
    reach = half_width + BLEND_MARGIN + 1.25 * blend / voxel_size if blend else half_width
    result = with_band(first, voxel_size, reach)
    for number, volume in enumerate(operands[1:], start=2):
        other = with_band(_on_grid_of(volume, first), voxel_size, reach)
        if blend:
            # The blend is a distance only away from the seam, but the next operand needs distances in a wide band.
            blended = call_openvdb(operations.smooth_csg, result, other, kind=kind, blend=blend)
            width = half_width if number == len(operands) else reach
            result = redistance(blended, voxel_size, width)
        else:
            combined = call_openvdb(operations.csg, result, other, kind=kind)
            one, two, side = UNIONS[kind]
            result = without_false_walls(combined, (result, one), (other, two), voxel_size, side)
    combined = with_widths(with_band(result, voxel_size, half_width), voxel_size, widths)
    return with_more(combined, world_metadata(**said))


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


def _combined_masks(kind: str, operands: Sequence[SparseVolume], names: Sequence[str]) -> SparseVolume:
    """The voxels on in at least one mask ("union"), in all of them ("intersection"), or only in the first.

    Raises:
        InputError: The masks lie on different lattices.
        UnsupportedGridError: A grid is not a mask.
        DeviceMemoryError: Their tiles hold more voxels than fit into memory.
    """
    wanted = operands[0].info.transform
    tolerance = 8 * math.ulp(float(np.abs(wanted).max()))
    for volume, name in zip(operands, names, strict=True):
        require_volume(volume, name, ("mask",))
        if not np.allclose(volume.info.transform, wanted, rtol=0.0, atol=tolerance):
            raise InputError(
                f"{name}: the voxels of mask {volume.info.name!r} are not those of {operands[0].info.name!r}; resample "
                "it with order=0 and the transform of the first"
            )
    trees = [voxelized_tree(tree_of(volume), volume.info.name) for volume in operands]
    origins = np.unique(np.concatenate([tree.origins for tree in trees]), axis=0)
    masks: NDArray[np.uint8] = np.zeros((len(origins), 64), np.uint8)
    for number, tree in enumerate(trees):
        own = np.zeros_like(masks)
        own[RowTable(origins).find(tree.origins)] = tree.masks
        if number == 0 or kind == "union":
            masks |= own
        elif kind == "intersection":
            masks &= own
        else:
            masks &= ~own
    some = masks.any(axis=1)
    masks = masks[some]
    alone = tree_of_leaves(trees[0].layout, trees[0].background, origins[some], masks, bits_of(masks))
    return rebuilt(alone, operands[0])
