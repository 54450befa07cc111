"""Derivatives of samples with respect to the points, from the gradients there."""

from typing import Any

# mypy: ignore-errors
import warp as wp

from geokit.core.gradients.sums_kernels import overloads

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def sample_slopes_kernel(
    first: int,
    components: int,
    by_sample: wp.array(dtype=Any),
    gradient: wp.array(dtype=Any),
    out_slopes: wp.array(dtype=Any),
):
    """The slopes of the points: those of their samples, which have some components each, times the gradients."""
    i = first + wp.tid()
    total = type(out_slopes[i])()
    for k in range(components):
        total += by_sample[components * i + k] * gradient[components * i + k]
    out_slopes[i] = total


# By the type of the points' coordinates.
SAMPLE_SLOPES = overloads(sample_slopes_kernel, ("gradient", "out_slopes"), ("by_sample",))
