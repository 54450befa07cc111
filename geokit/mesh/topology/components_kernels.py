"""Connected components by parallel union-find.

``label`` holds a forest: the parent of each node, which is never above it; a root is its own parent. A root only ever
gets a lower root as its parent. So each component ends with its lowest node as the root, whatever the order of the
links.
"""

# mypy: ignore-errors
import warp as wp

from geokit.core.atomic_kernels import root_of, unite

wp.set_module_options({"enable_backward": False})


@wp.kernel
def join_kernel(
    first: int,
    one: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    out_label: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    unite(out_label, one[i], other[i])


@wp.kernel
def lowest_kernel(first: int, label: wp.array(dtype=wp.int32), out_label: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out_label[i] = root_of(label, label[i])
