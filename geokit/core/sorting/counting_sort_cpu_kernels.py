"""The prefix sum of a counting sort: where each bucket begins, and each share of the items within it."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_kernel(first: int, shares: int, buckets: int, counts: wp.array(dtype=int), out_start: wp.array(dtype=int)):
    """Turns ``counts``, a row by bucket for each share, into where the items of each share and bucket go.

    The shares of a bucket follow each other, so that items stay in their order. ``out_start`` is where
    buckets begin, and at its end how many items there are. One item does it all: it is a sum along the buckets.
    """
    total = int(0)
    for bucket in range(buckets):
        out_start[bucket] = total
        at = bucket
        for _share in range(shares):
            items = counts[at]
            counts[at] = total
            total += items
            at += buckets
    for end in range(buckets, out_start.shape[0]):
        out_start[end] = total
