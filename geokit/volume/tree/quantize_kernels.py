"""Encodes float leaves as codes of 1 to 16 bits, bit for bit as NanoVDB writes them, and measures the readers' errors.

Every float32 rounding matters here: product and sum are never fused, except where the code says so.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.kernel
@cpp.native_item("volume/tree/quantize.inl", "fewest_bits")
def bits_kernel(first: int):
    """Smallest width in bits that keeps a leaf's error within its tolerance, 16 if none does."""


@wp.kernel
@cpp.native_item("volume/tree/quantize.inl", "write_leaf")
def encode_kernel(first: int):
    """Writes leaves; ``measures`` holds the largest error and the smallest and largest active value of each."""
