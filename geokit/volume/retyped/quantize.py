"""Quantized grids: 1 to 16 bits a voxel instead of 32, with a known error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.core.interop import user_arrays
from geokit.core.memory.needs import needs
from geokit.core.require import require_choice, require_flag
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume.model.sparse_volume import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import HEAD_SIZE, grid_header, info_of
from geokit.volume.nanovdb.layout import GRID_TYPES
from geokit.volume.nanovdb.provenance import with_error
from geokit.volume.nanovdb.types import BY_NAME, FIXED_BITS, QUANTIZED
from geokit.volume.tree.estimates import leaf_count
from geokit.volume.tree.leaf_codecs import HEADER, LeafReader, fewest_bits, thresholds, write_codes, write_floats
from geokit.volume.tree.leaves import require_volume
from geokit.volume.tree.retype_tree import retype_tree, tile_values

CODECS = ("float", *QUANTIZED)
SOURCES = ("float", "double", *QUANTIZED)
# Kernels report a larger value than this if the span of a leaf's values exceeds float32.
LARGEST_ERROR = 2.0 * float(np.finfo(np.float32).max)
# Classes that NanoVDB allows for float grids but not for quantized ones.
UNQUANTIZED_CLASSES = tuple(set(BY_NAME["float"].classes).difference(*(BY_NAME[name].classes for name in QUANTIZED)))


@needs(lambda volume, *_, **__: 2200 * leaf_count(volume))
def quantize(
    volume: SparseVolume, codec: str | None = None, *, tolerance: float | None = None, dither: bool = False
) -> SparseVolume:
    """Quantize a volume to fewer bits a voxel, or convert a quantized volume back to float.

    Every leaf of 8^3 voxels is stored as codes between the smallest and the largest of its values, active or not: 4
    ("fp4"), 8 ("fp8") or 16 ("fp16") bits for all leaves, or as many of 1, 2, 4, 8, 16 as each leaf needs ("fpn").
    Tiles, background, active states and transform do not change. The error in a leaf is at most half a step, ``range /
    (2 (2^bits - 1))``, or a whole step with dithering, plus the rounding of float32.

    ``metadata["geokit:achieved_error"]`` is the largest measured change of any voxel, for either way in which readers
    round. It is added to the error that the metadata already holds; the tolerance is added likewise. Trilinear
    interpolation is a weighted mean, so between voxels ``sample`` is off by no more (apart from its own roundings).
    Gradients are off by up to twice the error per voxel size.

    In a level set the error of a codec is at most half_width / (2^bits - 1), whatever the curvature. Up to a radius of
    2 (fp4), 16 (fp8) and 4096 (fp16) voxels, sampling at order 1 is then off by at most three times the 0.25 voxel^2 /
    radius by which it is off without quantization (half width 3).

    Args:
        volume: A grid of type float, double, fp4, fp8, fp16 or fpn.
        codec: "fp4", "fp8", "fp16", "fpn", or "float" for 32-bit floats; None for the smallest that keeps the tolerance
            (of two equally small ones, the one that is faster to read).
        tolerance: Largest change of a voxel [value units]; required for "fpn" and None.
        dither: Round neighboring voxels differently, so that means over some voxels are more exact than a single voxel;
            the error of a voxel doubles.
    Returns:
        SparseVolume of the codec's type. Without dithering the codes are bit for bit those of NanoVDB.
    Raises:
        InputError: The codec or tolerance is invalid, the codec does not keep the tolerance (the message states the
            error that it reaches), or the grid holds values that are not finite.
        UnsupportedGridError: The grid has another type, or a class that NanoVDB does not quantize.
    Source:
        NanoVDB (Museth 2021), GridBuilder.h. Differs: the error is measured.
    Example:
        >>> import geokit as gk
        >>> torus = gk.volume.load("data/samples/torus.vdb")
        >>> small = quantize(torus, tolerance=1e-3)
        >>> small.info.grid_type, small.info.metadata["geokit:achieved_error"] <= 1e-3
        ('fpn', True)
    """
    require_flag(dither, "dither")
    tolerance = _checked(require_volume(volume, "volume"), codec, tolerance)
    check_volume(volume)
    reader = LeafReader(volume.nanovdb)
    rounding = thresholds(dither)
    if codec in (None, "fpn"):
        assert tolerance is not None
        bits = fewest_bits(reader, tolerance, rounding)
        if codec is None:
            codec = _smallest(bits)
    else:
        bits = np.full(reader.count, FIXED_BITS.get(codec, 32), np.uint8)
    # Leaves with 32 bits a voxel have a header of the same size.
    retyped = retype_tree(volume.nanovdb, GRID_TYPES.index(codec), HEADER + 64 * bits.astype(np.int64))
    error = write_floats(reader, retyped) if codec == "float" else write_codes(reader, retyped, bits, rounding)
    achieved = max(error, _tile_error(volume))
    if achieved > LARGEST_ERROR or (tolerance is not None and achieved > tolerance):
        if tolerance is None:
            raise InputError(f"volume: the values spread over more than the {codec} codec can tell apart; clamp them")
        raise InputError(
            f"tolerance: {codec} reaches {achieved:.3g} on this grid, not {tolerance:g}; use a larger one, or more bits"
        )
    buffer = retyped.buffer
    grid_header(buffer)["checksum"] = partial_checksum(buffer[:HEAD_SIZE], buffer)
    buffer.setflags(write=False)
    return SparseVolume(buffer, info_of(buffer, with_error(volume.info.metadata, tolerance, achieved)))


def _checked(volume: SparseVolume, codec: str | None, tolerance: float | None) -> float | None:
    if codec is not None:
        require_choice(codec, "codec", CODECS)
    if tolerance is not None:
        tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance", low=user_arrays.FROM_ZERO)
    elif codec in (None, "fpn"):
        raise InputError(f"tolerance: codec {codec!r} needs one; say by how much a voxel may change")
    if volume.info.grid_type not in SOURCES:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} is of type {volume.info.grid_type}; only {', '.join(SOURCES)} can be "
            "quantized"
        )
    if codec != "float" and volume.info.grid_class in UNQUANTIZED_CLASSES:
        raise UnsupportedGridError(
            f"volume: NanoVDB has no quantized grids of class {volume.info.grid_class!r}; use codec 'float'"
        )
    return tolerance


def _smallest(bits: NDArray[np.uint8]) -> str:
    # If all leaves have one width, a fixed codec is as small, and its readers find a leaf without reading the others.
    for codec, width in FIXED_BITS.items():
        if (bits == width).all():
            return codec
    return "fpn"


def _tile_error(volume: SparseVolume) -> float:
    """Largest rounding error of tiles and background: 0 unless they are of double precision."""
    if volume.info.grid_type != "double":
        return 0.0
    values = tile_values(volume.nanovdb)
    with np.errstate(over="ignore"):
        return float(np.abs(values - values.astype(np.float32)).max())
