"""Encodes float leaves as codes of 1 to 16 bits, bit for bit as NanoVDB writes them, and measures the readers' errors.

Every float32 rounding matters here: product and sum are never fused, except where the code says so.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@cpp.func_native("volume/tree/quantize.inl")
def leaf_error(
    source: wp.array(dtype=wp.uint8), start: wp.int64, bits: int, rounding: wp.array(dtype=wp.float32)
) -> wp.float64:
    """Largest error of a leaf's values as codes of ``bits`` bits; -1 if a value is not finite."""
    ...


@wp.kernel
def bits_kernel(
    first: int,
    source: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.int64),
    tolerance: wp.array(dtype=wp.float64),
    rounding: wp.array(dtype=wp.float32),
    out_bits: wp.array(dtype=wp.uint8),
):
    """Smallest width in bits that keeps a leaf's error within its tolerance, 16 if none does."""
    i = first + wp.tid()
    bits = int(1)
    while bits < 16 and leaf_error(source, starts[i], bits, rounding) > tolerance[i]:
        bits *= 2
    out_bits[i] = wp.uint8(bits)


@wp.kernel
@cpp.native_item("volume/tree/quantize.inl", "write_leaf")
def encode_kernel(
    first: int,
    source: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.int64),
    bits: wp.array(dtype=wp.uint8),
    flags: wp.array(dtype=wp.uint8),
    rounding: wp.array(dtype=wp.float32),
    places: wp.array(dtype=wp.int64),
    target: wp.array(dtype=wp.uint8),
    out_measures: wp.array(dtype=wp.vec3d),
):
    """Writes leaves; ``measures`` holds the largest error and the smallest and largest active value of each."""
