"""Mean distances to neighbors, and the comparison with a threshold."""

# mypy: ignore-errors
import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})


@wp.kernel
def mean_distance_kernel(
    first: int,
    distance: wp.array(dtype=wp.float64, ndim=2),
    out_mean: wp.array(dtype=wp.float64),
):
    """Mean of the finite distances of each row, summed from the nearest on; 0 if there is none."""
    i = first + wp.tid()
    total = wp.float64(0.0)
    found = wp.int32(0)
    for k in range(distance.shape[1]):
        d = distance[i, k]
        if wp.isfinite(d):
            total += d
            found += 1
    mean = wp.float64(0.0)
    if found > 0:
        mean = total / wp.float64(found)
    out_mean[i] = mean


@wp.kernel
def above_kernel(
    first: int, value: wp.array(dtype=wp.float64), threshold: wp.float64, out_above: wp.array(dtype=wp.bool)
):
    i = first + wp.tid()
    out_above[i] = value[i] > threshold


@wp.kernel
def below_kernel(first: int, value: wp.array(dtype=wp.int32), threshold: wp.int32, out_below: wp.array(dtype=wp.bool)):
    i = first + wp.tid()
    out_below[i] = value[i] < threshold
