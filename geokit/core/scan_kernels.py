"""The last of a device's prefix sums."""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})

__all__ = ["last_kernel"]


@wp.kernel
def last_kernel(first: int, sums: wp.array(dtype=int), out_last: wp.array(dtype=int)):
    out_last[first] = sums[sums.shape[0] - 1]
