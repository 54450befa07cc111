"""Smoothing of level sets and of other scalar volumes."""

from __future__ import annotations

from geokit.core.memory.needs import needs
from geokit.core.require import require_count, require_text
from geokit.errors import InputError
from geokit.volume.level_set.band_widths import widths_of, with_widths
from geokit.volume.level_set.operands import require_level_set, with_band
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.openvdb_call import call_openvdb

LEVEL_SET_METHODS = ("gaussian", "mean", "median", "mean_curvature", "laplacian")
FIELD_METHODS = ("gaussian", "mean", "median")
# OpenVDB copies each leaf with this many voxels around it.
WIDEST = 64
MOST_ITERATIONS = 10_000


@needs(lambda volume, *_, **__: 7800 * leaf_count(volume), fatal=True)
def smooth(volume: SparseVolume, method: str = "gaussian", *, width: int = 1, iterations: int = 1) -> SparseVolume:
    """Smooth a level set or another scalar volume.

    In level sets the surface moves: "gaussian" (four box filters), "mean" and "median" filter over a cube,
    "mean_curvature" and "laplacian" take one step of the flow. After each iteration the band follows the surface and
    its values are corrected towards distances. Other volumes are filtered at their active voxels, with the background
    outside. The enclosed volume is not preserved: convex bodies shrink.

    One gaussian pass of width 1 moves the surface inwards by 2.7 voxel^2 over the radius of curvature, to 0.05 voxel
    from a radius of 8 voxels on; balls of 2 voxels and less disappear.

    Args:
        volume: Float or double grid; quantized ones become float.
        method: "gaussian", "mean" or "median"; for level sets also "mean_curvature" or "laplacian".
        width: Half the side of the filter [voxels], 1 to 64; the two flows ignore it.
        iterations: Number of passes.
    Returns:
        Volume of the same class and background; a band of two widths keeps both.
    Raises:
        InputError: The method is unknown, or is for level sets and the grid is none; width or iterations is out of
            range; the voxels of a level set are not cubes, or its background is not positive and finite; or the grid
            lies within 8,192 voxels of index 2^31.
        UnsupportedGridError: Values are not real numbers.
        DeviceMemoryError: OpenVDB's copies of the grid do not fit into memory.
        MissingDependencyError: geokit was built without OpenVDB.
    Source:
        OpenVDB's LevelSetFilter and Filter.
    """
    require_volume(volume, "volume", ("float", "double"))
    is_level_set = volume.info.grid_class == "level set"
    known = LEVEL_SET_METHODS if is_level_set else FIELD_METHODS
    if require_text(method, "method") not in known:
        kind = "a level set" if is_level_set else f"a grid of class {volume.info.grid_class}"
        raise InputError(f"method: {method!r} does not smooth {kind}; use one of {', '.join(known)}")
    width = require_count(width, "width", 1, WIDEST)
    iterations = require_count(iterations, "iterations", 1, MOST_ITERATIONS)
    voxel_size = require_level_set(volume, "volume") if is_level_set else 1.0
    from geokit.native import operations

    def smoothed(source: SparseVolume) -> SparseVolume:
        result: SparseVolume = call_openvdb(
            operations.smooth, source, method=method, width=width, iterations=iterations, voxel_size=voxel_size
        )
        return result

    if not is_level_set:
        return smoothed(volume)
    widths = widths_of(volume, voxel_size)
    source = volume if widths.are_equal else with_band(volume, voxel_size, widths.widest)
    return with_widths(smoothed(source), voxel_size, widths)
