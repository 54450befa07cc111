"""Morton order on a CPU, by all threads: the highest bits of a key say where its point goes, the rest is sorted there.

As stable as one sort of all keys, so that the order is the same for any number of threads.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Highest bits of a key, by which the points are put into buckets: one for each of their values.
TOP_BITS = 12
BUCKETS = 1 << TOP_BITS
LOW_BITS = 30 - TOP_BITS
# From MANY points of a bucket on nine bits are sorted at a time, below six; below FEW there is an insertion sort.
MANY, FEW = 1024, 24


_CONSTANTS = {"BUCKETS": BUCKETS, "LOW_BITS": LOW_BITS, "MANY": MANY, "FEW": FEW}


@wp.kernel
@cpp.native_item("core/morton_order_cpu.inl", "count_share", **_CONSTANTS)
def count_kernel(first: int):
    """Keys of a share of the points, and how many are in each bucket; ``out_counts`` has a row for each share."""


@wp.kernel
@cpp.native_item("core/morton_order_cpu.inl", "place_share", **_CONSTANTS)
def place_kernel(first: int):
    """Puts the low bits of each key, and the number of its point, into its bucket; moves ``places`` on."""


@wp.kernel
@cpp.native_item("core/morton_order_cpu.inl", "sort_bucket", **_CONSTANTS)
def sort_kernel(first: int):
    """The points of a bucket in the order of their keys."""
