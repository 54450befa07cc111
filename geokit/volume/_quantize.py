"""Quantised grids: 1 to 16 bits a voxel instead of 32, with a known error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geokit.core import user_arrays
from geokit.errors import InputError, UnsupportedGridError
from geokit.volume._model import SparseVolume
from geokit.volume.nanovdb.checks import check_volume
from geokit.volume.nanovdb.checksum import partial_checksum
from geokit.volume.nanovdb.header import HEAD_SIZE, grid_header, info_of
from geokit.volume.nanovdb.layout import GRID_TYPES
from geokit.volume.nanovdb.provenance import with_error
from geokit.volume.nanovdb.types import BY_NAME, FIXED_BITS, QUANTIZED
from geokit.volume.tree.leaf_codecs import HEADER, LeafReader, fewest_bits, thresholds, write_codes, write_floats
from geokit.volume.tree.retype_tree import retype_tree, tile_values

__all__ = ["quantize"]

CODECS = ("float", *QUANTIZED)
SOURCES = ("float", "double", *QUANTIZED)
# What the kernels say where the values of a leaf span more than float32 holds is larger.
LARGEST_ERROR = 2.0 * float(np.finfo(np.float32).max)
# Classes that NanoVDB allows for float grids but not for quantised ones.
UNQUANTISED_CLASSES = tuple(set(BY_NAME["float"].classes).difference(*(BY_NAME[name].classes for name in QUANTIZED)))


def quantize(
    volume: SparseVolume, codec: str | None = None, *, tolerance: float | None = None, dither: bool = False
) -> SparseVolume:
    """A volume with fewer bits a voxel, or with the float values of such a volume.

    Every leaf of 8^3 voxels is stored as codes between its smallest and its largest value, active or not: 4 ("fp4"), 8
    ("fp8") or 16 ("fp16") bits for all leaves, or as many of 1, 2, 4, 8, 16 as each leaf needs ("fpn"). Tiles,
    background, active states and transform stay as they are. A leaf's error is at most half a step,
    ``range / (2 (2^bits - 1))``, a whole one with dithering, plus the rounding of float32.

    ``metadata["geokit:achieved_error"]`` is the largest change of any voxel, measured, whichever way a reader rounds.
    It is added to the error that the metadata knows of already, and so is the tolerance. Trilinear interpolation takes
    means: between the voxels ``sample`` is off by no more (and the roundings of its own). Gradients are off by up to
    twice the error per voxel size. Held by tests/volume/tree/test_quantize.py,
    tests/volume/tree/test_quantize_property.py and tests/volume/tree/test_quantize_stability.py.

    Of a level set a codec is off by at most half_width / (2^bits - 1), whatever the curvature: up to a radius of 2
    (fp4), 16 (fp8) and 4096 (fp16) voxels, sampling at order 1 is then off by at most three times the 0.25 voxel^2 /
    radius that it is off by anyway (half width 3). Held by tests/accuracy/stability/test_envelopes.py.

    Args:
        volume: A grid of type float, double, fp4, fp8, fp16 or fpn.
        codec: "fp4", "fp8", "fp16", "fpn", or "float" for 32-bit floats; None for the smallest that keeps the
            tolerance (of two that are equally small, the one that is quicker to read).
        tolerance: Largest change of a voxel [value units]; "fpn" and None need it.
        dither: Let neighbouring voxels round differently, so that means over some voxels keep more of the values than
            one voxel shows; the error of a voxel doubles.
    Returns:
        SparseVolume of the codec's type; codes are the same bit for bit as NanoVDB's own without dithering.
    Raises:
        InputError: The codec or tolerance cannot be used, the codec does not keep the tolerance (the message says which
            error it reaches), or the grid holds values that are not finite.
        UnsupportedGridError: The grid is of another type, or of a class that NanoVDB does not quantise.
    Source:
        NanoVDB (Museth 2021), GridBuilder.h. Differs: the error is measured.
    Example:
        >>> import geokit as gk
        >>> torus = gk.volume.load("data/samples/torus.vdb")
        >>> small = quantize(torus, tolerance=1e-3)
        >>> small.info.grid_type, small.info.metadata["geokit:achieved_error"] <= 1e-3
        ('fpn', True)
    """
    tolerance = _checked(volume, codec, tolerance)
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
    # Leaves of 32 bits have a header of the same size.
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
    if codec is not None and codec not in CODECS:
        raise InputError(f"codec: {codec!r} is unknown; use one of {', '.join(CODECS)}, or None with a tolerance")
    if tolerance is not None:
        tolerance = user_arrays.require_finite_scalar(tolerance, "tolerance")
        if tolerance < 0.0:
            raise InputError(f"tolerance: {tolerance} is negative; use 0 or more")
    elif codec in (None, "fpn"):
        raise InputError(f"tolerance: codec {codec!r} needs one; say by how much a voxel may change")
    if volume.info.grid_type not in SOURCES:
        raise UnsupportedGridError(
            f"volume: grid {volume.info.name!r} is of type {volume.info.grid_type}; only {', '.join(SOURCES)} can be "
            "quantised"
        )
    if codec != "float" and volume.info.grid_class in UNQUANTISED_CLASSES:
        raise UnsupportedGridError(
            f"volume: NanoVDB has no quantised grids of class {volume.info.grid_class!r}; use codec 'float'"
        )
    return tolerance


def _smallest(bits: NDArray[np.uint8]) -> str:
    # Leaves of one width take as much room in a fixed codec, which finds them without a look at each.
    for codec, width in FIXED_BITS.items():
        if (bits == width).all():
            return codec
    return "fpn"


def _tile_error(volume: SparseVolume) -> float:
    """What tiles and background lose: nothing unless they are of double precision."""
    if volume.info.grid_type != "double":
        return 0.0
    values = tile_values(volume.nanovdb)
    with np.errstate(over="ignore"):
        return float(np.abs(values - values.astype(np.float32)).max())
