"""Sums over the 3^3 or 4^3 voxels around a point, weighted along each index axis: interpolants and their derivatives.

Every sum runs over differences from the voxel whose centre is at the lower corner of the point's cell: where all voxels
are equal a value is that value and a derivative 0 exactly, whatever the weights round to, and a large common value
does not eat the digits of a small slope.

The stencil touches at most two nodes along each axis. Each is looked up once, as in :mod:`._read_kernels`, and voxels
are read by rows along the last axis, so that the choice by grid type is made once for a row.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import (
    _CODED,
    _SCALARS,
    _VECTORS_3,
    _VECTORS_4,
    FLOAT_TYPE,
    _element,
    _in_leaf,
    grid_type_of,
    node_of,
    read_voxel,
)
from geokit.volume.sampling.stencil_float_kernels import float_bends, float_slopes, float_value

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

mat34d = wp.types.matrix(shape=(3, 4), dtype=wp.float64)


def _row_reader(family, components):
    """C++ that returns the differences of the voxels (i, j, k) to (i, j, k + count - 1) from ``centre``.

    The first ``cut`` of them are in the node ``near``, the others in ``far``; what is left of a row of four is 0.
    """
    shape = "wp::vec_t<4, double>" if components == 1 else f"wp::mat_t<{components}, 4, double>"
    entries = ["row[q]"] if components == 1 else [f"row.data[{e}][q]" for e in range(components)]
    from_centre = ["centre"] if components == 1 else [f"centre[{e}]" for e in range(components)]
    leaves, tiles = [], []
    for name, kind in family.items():
        whole = _CODED[kind][1] if kind in _CODED else kind
        voxel = " ".join(
            f"{entries[e]} = (double)({_in_leaf(name, kind, e)}) - {from_centre[e]};" for e in range(components)
        )
        tile = " ".join(
            f"{entries[e]} = (double)({_element(whole, 'leaf.address', e)}) - {from_centre[e]};"
            for e in range(components)
        )
        case = f"case PNANOVDB_GRID_TYPE_{name}:"
        loop = "for (int q = begin; q < end; ++q)"
        leaves.append(f"{case} {loop} {{ ijk.z = k + q; const unsigned n = first + q; {voxel} }} break;")
        tiles.append(f"{case} {loop} {{ {tile} }} break;")
    # A type of another family gives no number at all.
    none = (
        f"default: for (int q = begin; q < end; ++q) {{ {' '.join(f'{entry} = (double)NAN;' for entry in entries)} }}"
    )
    leaves, tiles = "\n".join(leaves), "\n".join(tiles)
    return f"""
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    wp::half half;
    {shape} row;
    pnanovdb_coord_t ijk = {{ i, j, k }};
    const int parts = cut < count ? 2 : 1;
    for (int part = 0; part < parts; ++part) {{
        const int begin = part ? cut : 0;
        const int end = part ? count : cut;
        const unsigned long long node = part ? far : near;
        const pnanovdb_leaf_handle_t leaf = {{ node & ~1ull }};
        ijk.z = k + begin;
        // Voxels of a row follow each other.
        const unsigned first = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk)) - (unsigned)begin;
        if (node & 1u) {{
            switch (grid_type) {{
            {leaves}
            {none}
            }}
        }} else {{
            switch (grid_type) {{
            {tiles}
            {none}
            }}
        }}
    }}
    return row;
    """


@wp.func_native(_row_reader(_SCALARS, 1))
def read_row(
    volume: wp.uint64,
    grid_type: int,
    near: wp.uint64,
    far: wp.uint64,
    i: int,
    j: int,
    k: int,
    cut: int,
    count: int,
    centre: wp.float64,
) -> wp.vec4d:
    """Differences of up to four voxels along the last axis from a value, by the nodes that node_of found for them."""
    ...


@wp.func_native(_row_reader(_VECTORS_3, 3))
def read_row(  # noqa: F811
    volume: wp.uint64,
    grid_type: int,
    near: wp.uint64,
    far: wp.uint64,
    i: int,
    j: int,
    k: int,
    cut: int,
    count: int,
    centre: wp.vec3d,
) -> mat34d: ...


@wp.func_native(_row_reader(_VECTORS_4, 4))
def read_row(  # noqa: F811
    volume: wp.uint64,
    grid_type: int,
    near: wp.uint64,
    far: wp.uint64,
    i: int,
    j: int,
    k: int,
    cut: int,
    count: int,
    centre: wp.vec4d,
) -> wp.mat44d: ...


@wp.func
def along(row: wp.vec4d, weights: wp.vec4d):
    return wp.dot(row, weights)


@wp.func
def along(row: mat34d, weights: wp.vec4d):  # noqa: F811
    return row * weights


@wp.func
def along(row: wp.mat44d, weights: wp.vec4d):  # noqa: F811
    return row * weights


@wp.func
def slab_nodes(volume: wp.uint64, kind: int, x: int, j: int, k: int, cut_j: int, cut_k: int, count: int):
    """The nodes of the stencil's voxels with first index x: below and above the border along j, each along k."""
    n00 = node_of(volume, kind, x, j, k)
    n01 = n00
    n10 = n00
    if cut_k < count:
        n01 = node_of(volume, kind, x, j, k + cut_k)
    n11 = n01
    if cut_j < count:
        n10 = node_of(volume, kind, x, j + cut_j, k)
        n11 = n10
        if cut_k < count:
            n11 = node_of(volume, kind, x, j + cut_j, k + cut_k)
    return n00, n01, n10, n11


@wp.func
def nodes_of_row(n00: wp.uint64, n01: wp.uint64, n10: wp.uint64, n11: wp.uint64, beyond: bool):
    """Of a slab's four nodes the two that a row lies in, by whether it is beyond the border along j."""
    if beyond:
        return n10, n11
    return n00, n01


@wp.func
def voxel_at(volume: wp.uint64, kind: int, i: int, j: int, k: int, family: Any):
    return read_voxel(volume, kind, node_of(volume, kind, i, j, k), i, j, k, family)


@wp.func
def voxels_to_border(first: int, count: int) -> int:
    """How many of ``count`` voxels from ``first`` on lie before the next border of leaves, at most all."""
    return wp.min(count, 8 - (first & 7))


@wp.func
def value_by_rows(volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any):
    """stencil_value of a grid of any type."""
    kind = grid_type_of(volume)
    i = int(base[0]) - 1
    j = int(base[1]) - 1
    k = int(base[2]) - 1
    cut_j = voxels_to_border(j, count)
    cut_k = voxels_to_border(k, count)
    centre = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    total = zero
    z0 = z[0]
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, centre)
            total += along(row, z0) * (x[0, a] * y[0, b])
    return centre + total


@wp.func
def slopes_by_rows(volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any):
    """stencil_slopes of a grid of any type."""
    kind = grid_type_of(volume)
    i = int(base[0]) - 1
    j = int(base[1]) - 1
    k = int(base[2]) - 1
    cut_j = voxels_to_border(j, count)
    cut_k = voxels_to_border(k, count)
    centre = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    along_i = zero
    along_j = zero
    along_k = zero
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, centre)
            value = along(row, z[0])
            along_i += value * (x[1, a] * y[0, b])
            along_j += value * (x[0, a] * y[1, b])
            along_k += along(row, z[1]) * (x[0, a] * y[0, b])
    return along_i, along_j, along_k


@wp.func
def bends_by_rows(volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d):
    """stencil_bends of a grid of any scalar type."""
    zero = wp.float64(0.0)
    kind = grid_type_of(volume)
    i = int(base[0]) - 1
    j = int(base[1]) - 1
    k = int(base[2]) - 1
    cut_j = voxels_to_border(j, count)
    cut_k = voxels_to_border(k, count)
    centre = voxel_at(volume, kind, i + 1, j + 1, k + 1, zero)
    slope = wp.vec3d()
    straight = wp.vec3d()
    mixed = wp.vec3d()
    n00 = wp.uint64(0)
    n01 = wp.uint64(0)
    n10 = wp.uint64(0)
    n11 = wp.uint64(0)
    for a in range(count):
        if a == 0 or ((i + a) & 7) == 0:
            n00, n01, n10, n11 = slab_nodes(volume, kind, i + a, j, k, cut_j, cut_k, count)
        for b in range(count):
            near, far = nodes_of_row(n00, n01, n10, n11, b >= cut_j)
            row = read_row(volume, kind, near, far, i + a, j + b, k, cut_k, count, centre)
            r0 = along(row, z[0])
            r1 = along(row, z[1])
            r2 = along(row, z[2])
            weight = x[0, a] * y[0, b]
            slope += wp.vec3d(r0 * x[1, a] * y[0, b], r0 * x[0, a] * y[1, b], r1 * weight)
            straight += wp.vec3d(r0 * x[2, a] * y[0, b], r0 * x[0, a] * y[2, b], r2 * weight)
            # The pairs (j, k), (i, k), (i, j).
            mixed += wp.vec3d(r1 * x[0, a] * y[1, b], r1 * x[1, a] * y[0, b], r0 * x[1, a] * y[1, b])
    second = wp.mat33d(
        straight[0], mixed[2], mixed[1],
        mixed[2], straight[1], mixed[0],
        mixed[1], mixed[0], straight[2],
    )  # fmt: skip
    return slope, second


@wp.func
def stencil_value(
    volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: wp.float64
):
    """Weighted sum of ``count``^3 voxels, from the one before ``base`` on along each axis.

    The weights of each axis are the first row of its matrix and add up to 1.
    """
    if grid_type_of(volume) == FLOAT_TYPE:
        return float_value(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, count, x, y, z)
    return value_by_rows(volume, base, count, x, y, z, zero)


@wp.func
def stencil_value(  # noqa: F811
    volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any
):
    return value_by_rows(volume, base, count, x, y, z, zero)


@wp.func
def stencil_slopes(
    volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: wp.float64
):
    """As stencil_value, its derivatives along each index axis; the second rows are the derivatives of the weights."""
    if grid_type_of(volume) == FLOAT_TYPE:
        d = float_slopes(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, count, x, y, z)
        return d[0], d[1], d[2]
    return slopes_by_rows(volume, base, count, x, y, z, zero)


@wp.func
def stencil_slopes(  # noqa: F811
    volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d, zero: Any
):
    return slopes_by_rows(volume, base, count, x, y, z, zero)


@wp.func
def stencil_bends(volume: wp.uint64, base: wp.vec3d, count: int, x: wp.mat44d, y: wp.mat44d, z: wp.mat44d):
    """First derivatives along the index axes, and the symmetric matrix of the second ones, of a scalar grid.

    The third rows are the second derivatives of the weights.
    """
    if grid_type_of(volume) == FLOAT_TYPE:
        d = float_bends(volume, int(base[0]) - 1, int(base[1]) - 1, int(base[2]) - 1, count, x, y, z)
        return wp.vec3d(d[0], d[1], d[2]), wp.mat33d(d[3], d[8], d[7], d[8], d[4], d[6], d[7], d[6], d[5])
    return bends_by_rows(volume, base, count, x, y, z)
