"""Kernels that find a narrow band's active voxels and write their values into the leaves of a grid."""

# mypy: ignore-errors
import warp as wp

from geokit.core import cpp

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "fuse_fp": False})


@wp.kernel
def near_rows_kernel(
    first: int,
    distance: wp.array2d(dtype=wp.float32),
    lowest: wp.float32,
    highest: wp.float32,
    out_near: wp.array(dtype=int),
):
    """1 for tiles with a distance between ``lowest`` and ``highest``."""
    i = first + wp.tid()
    near = int(0)
    voxel = int(0)
    while near == 0 and voxel < 512:
        if distance[i, voxel] > lowest and distance[i, voxel] < highest:
            near = int(1)
        voxel += 1
    out_near[i] = near


@wp.kernel
def set_rows_kernel(
    first: int,
    bits: wp.array2d(dtype=wp.uint64),
    out_near: wp.array(dtype=int),
):
    """1 for leaves with a set bit."""
    i = first + wp.tid()
    some = wp.uint64(0)
    for x in range(8):
        some = some | bits[i, x]
    out_near[i] = wp.where(some != wp.uint64(0), 1, 0)


@wp.kernel
def any_bits_kernel(first: int, bits: wp.array2d(dtype=wp.uint64), out_some: wp.array(dtype=int)):
    """Raises ``out_some`` if any bit is set."""
    i = first + wp.tid()
    for x in range(8):
        if bits[i, x] != wp.uint64(0):
            out_some[0] = 1


@wp.kernel
def kept_bits_kernel(
    first: int, kept: wp.array(dtype=int), bits: wp.array2d(dtype=wp.uint64), out_bits: wp.array2d(dtype=wp.uint64)
):
    i = first + wp.tid()
    for x in range(8):
        out_bits[i, x] = bits[kept[i], x]


@wp.kernel
def surface_is_outside_kernel(
    first: int,
    rows: wp.array(dtype=int),
    distance: wp.array2d(dtype=wp.float32),
    on_surface: wp.float32,
    out_inside: wp.array2d(dtype=wp.uint64),
):
    """Clears the bits of the voxels on the surface; an item is a plane of a leaf."""
    i = first + wp.tid()
    t = i >> 3
    x = i & 7
    word = out_inside[t, x]
    if word != wp.uint64(0):
        for n in range(64):
            if distance[rows[t], 64 * x + n] <= on_surface:
                word = word & ~(wp.uint64(1) << wp.uint64(n))
        out_inside[t, x] = word


@wp.kernel
@cpp.native_item("volume/band/band.inl", "plane_bits")
def bits_kernel(
    first: int,
    distance: wp.array2d(dtype=wp.float32),
    inside: wp.array2d(dtype=wp.uint64),
    out_active: wp.array2d(dtype=wp.uint64),
    out_negative: wp.array2d(dtype=wp.uint64),
):
    """Bit masks of a plane's active voxels and of those with a negative value; ``inside`` may be empty.

    A negative value raises ``out_some``.
    """


@wp.kernel
@cpp.native_item("volume/band/band.inl", "write_plane")
def leaf_values_kernel(first: int, distance: wp.array2d(dtype=wp.float32), inside: wp.array2d(dtype=wp.uint64)):
    """Writes the values and the mask of a plane into the leaf."""


@wp.kernel
def triangle_values_kernel(
    first: int,
    rows: wp.array(dtype=int),
    slots: wp.array2d(dtype=int),
    active: wp.array2d(dtype=wp.uint64),
    slot_triangle: wp.array(dtype=int),
    out_values: wp.array(dtype=int),
):
    """Writes the triangle of each voxel of a plane, -1 for inactive ones; outputs are indexed by leaf, not by tile."""
    i = first + wp.tid()
    leaf = i >> 3
    x = i & 7
    for b in range(64):
        triangle = int(-1)
        if ((active[leaf, x] >> wp.uint64(b)) & wp.uint64(1)) != wp.uint64(0):
            slot = slots[rows[leaf], 64 * x + b]
            if slot >= 0:
                triangle = slot_triangle[slot]
        out_values[512 * leaf + 64 * x + b] = triangle
