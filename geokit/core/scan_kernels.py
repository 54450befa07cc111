"""Before and after a prefix sum on a device: wider counts, and the total."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

__all__ = ["last_kernel", "widen_kernel"]


@wp.kernel
def last_kernel(first: int, sums: wp.array(dtype=int), out_last: wp.array(dtype=int)):
    out_last[first] = sums[sums.shape[0] - 1]


@wp.kernel
def widen_kernel(first: int, counts: wp.array(dtype=wp.int32), out_counts: wp.array(dtype=wp.int64)):
    i = first + wp.tid()
    out_counts[i] = wp.int64(counts[i])
