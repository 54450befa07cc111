"""Table of the kernels for each kind of volume query.

Importing it compiles nothing: warp compiles a module of kernels at its first launch.
"""

from __future__ import annotations

from typing import Any

from geokit.core.base.late_warp import wp
from geokit.volume.sampling import cubic_kernels as cubic
from geokit.volume.sampling import quadratic_kernels as quadratic
from geokit.volume.sampling import sample_kernels as low
from geokit.volume.sampling import staggered_kernels as staggered

_OF_ONE_ORDER = {
    ("sample", 0): low.SAMPLE_NEAREST,
    ("sample", 1): low.SAMPLE_LINEAR,
    ("sample", 2): quadratic.SAMPLE_QUADRATIC,
    ("sample", 3): cubic.SAMPLE_CUBIC,
    ("gradient", 0): low.GRADIENT_NEAREST,
    ("gradient", 1): low.GRADIENT_LINEAR,
    ("gradient", 2): quadratic.GRADIENT_QUADRATIC,
    ("gradient", 3): cubic.GRADIENT_CUBIC,
    ("hessian", 2): {1: quadratic.hessian_quadratic_kernel},
    ("hessian", 3): {1: cubic.hessian_cubic_kernel},
}
# Keys: (what, order, components, staggered).
_KERNELS: dict[tuple[str, int, int, bool], Any] = {
    (what, order, components, False): kernel
    for (what, order), kernels in _OF_ONE_ORDER.items()
    for components, kernel in kernels.items()
}
_KERNELS |= {("sample", order, 3, True): staggered.sample_staggered_kernel for order in range(4)}
_KERNELS |= {("gradient", order, 3, True): staggered.gradient_staggered_kernel for order in range(4)}


def query_kernel(what: str, order: int, components: int, is_staggered: bool) -> tuple["wp.Kernel", list[int]]:
    """The kernel that samples or differentiates a volume at points, and its inputs after the common ones.

    Args:
        what: "sample", "gradient" or "hessian".
        order: Order of the interpolant.
        components: Components of a voxel.
        is_staggered: Whether each component lies on a face of its voxel.
    """
    return _KERNELS[what, order, components, is_staggered], [order] if is_staggered else []
