"""Rows where a map places them."""

# mypy: ignore-errors
import warp as wp

from geokit.core.scan_kernels import part_of

# Without fused multiply-adds a GPU gives the same bits as a CPU.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def move_kernel(
    first: int,
    rows: wp.array(dtype=wp.vec3d),
    linear: wp.mat33d,
    shift: wp.vec3d,
    out_rows: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    out_rows[i] = linear * rows[i] + shift


@wp.kernel
def move_packed_kernel(
    first: int,
    offsets: wp.array(dtype=int),
    rows: wp.array(dtype=wp.vec3d),
    linear: wp.array(dtype=wp.mat33d),
    shift: wp.array(dtype=wp.vec3d),
    out_rows: wp.array(dtype=wp.vec3d),
):
    """As move_kernel; map m makes the rows from ``offsets[m]`` on; after the last of the given the first follows."""
    i = first + wp.tid()
    of = part_of(offsets, i)
    out_rows[i] = linear[of] * rows[i % rows.shape[0]] + shift[of]
