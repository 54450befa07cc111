"""Around a prefix sum on a device: wider counts, the total, flagged items, and the part that an item belongs to."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@cpp.func_native("core/parts.inl")
def part_of(offsets: wp.array(dtype=int), item: int) -> int:
    """The part that an item belongs to: ``offsets`` has the first item of each part, and their number, (parts + 1,).

    Without that last entry the answer for the last part would be the one before it: ``wp.lower_bound`` never answers
    the length of its array.
    """
    ...


@wp.func
def begin_of(ends: wp.array(dtype=int), part: int) -> int:
    """Where a part begins, given where each ends: the sums of its items and of those of all parts before it."""
    begin = int(0)
    if part > 0:
        begin = ends[part - 1]
    return begin


@wp.kernel
def last_kernel(first: int, sums: wp.array(dtype=int), out_last: wp.array(dtype=int)):
    out_last[first] = sums[sums.shape[0] - 1]


@wp.kernel
def widen_kernel(first: int, counts: wp.array(dtype=wp.int32), out_counts: wp.array(dtype=wp.int64)):
    i = first + wp.tid()
    out_counts[i] = wp.int64(counts[i])


@wp.kernel
def flagged_kernel(first: int, flag: wp.array(dtype=int), ends: wp.array(dtype=int), out_item: wp.array(dtype=int)):
    i = first + wp.tid()
    if flag[i] != 0:
        out_item[ends[i] - 1] = i
