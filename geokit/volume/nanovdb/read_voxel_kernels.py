"""Reads one voxel of a NanoVDB grid of any value type as float64.

Warp's own ``volume_lookup*`` and ``volume_sample*`` know nine value types and give 0 for all others, such as the
quantised ones. These functions read through PNanoVDB, which warp compiles into its kernels anyway. Finding a voxel's
node and reading the voxel are two steps, so that the voxels of a leaf share the walk down the tree.

Nothing here checks the buffer: a grid whose offsets are damaged must have been refused before.
"""

from typing import Any

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})

FLOAT_TYPE = wp.constant(1)  # NanoVDB's number of float grids

vec8d = wp.types.vector(length=8, dtype=wp.float64)

# How PNanoVDB reads an element at the address AT, and the element's size in bytes.
# Its 16-bit read leaves the neighbouring element in the upper half.
_WORD = "(unsigned short)(pnanovdb_read_uint16(buf, AT) & 0xffffu)"
_ELEMENTS = {
    "float": ("pnanovdb_read_float(buf, AT)", 4),
    "double": ("pnanovdb_read_double(buf, AT)", 8),
    "int16": (f"(short){_WORD}", 2),
    "int32": ("pnanovdb_read_int32(buf, AT)", 4),
    "int64": ("pnanovdb_read_int64(buf, AT)", 8),
    "uint8": ("pnanovdb_read_uint8(buf, AT)", 1),
    "uint16": (_WORD, 2),
    "uint32": ("pnanovdb_read_uint32(buf, AT)", 4),
    "half": (f"(half.u = {_WORD}, wp::half_to_float(half))", 2),
}
# The families: PNanoVDB's names of the grid types, and what a voxel of a leaf consists of.
_SCALARS = {
    "FLOAT": "float",
    "DOUBLE": "double",
    "INT16": "int16",
    "INT32": "int32",
    "INT64": "int64",
    "UINT8": "uint8",
    "UINT32": "uint32",
    "HALF": "half",
    "BOOLEAN": "bit",
    "MASK": "mask",
    "FP4": "fp4",
    "FP8": "fp8",
    "FP16": "fp16",
    "FPN": "fpn",
}
_VECTORS_3 = {"VEC3F": "float", "VEC3D": "double", "VEC3U8": "uint8", "VEC3U16": "uint16"}
_VECTORS_4 = {"VEC4F": "float", "VEC4D": "double", "RGBA8": "uint8"}
# Voxels that are not plain elements: how voxel number n, at ijk, of a leaf whose table starts at AT is read, and the
# element of tiles and background. NanoVDB keeps the bits of a bool leaf right behind its mask, in the order of the
# voxels; PNanoVDB looks for them 16 bytes later and numbers them by x, so that it cannot be asked.
_CODED = {
    "bit": ("pnanovdb_read_bit(buf, pnanovdb_address_offset(leaf.address, 80u + (n >> 3u)), n & 7u)", "uint8"),
    "mask": ("pnanovdb_leaf_get_value_mask(buf, leaf, n)", "uint8"),
    "fp4": ("pnanovdb_leaf_fp4_read_float(buf, AT, PNANOVDB_REF(ijk))", "float"),
    "fp8": ("pnanovdb_leaf_fp8_read_float(buf, AT, PNANOVDB_REF(ijk))", "float"),
    "fp16": ("pnanovdb_leaf_fp16_read_float(buf, AT, PNANOVDB_REF(ijk))", "float"),
    "fpn": ("pnanovdb_leaf_fpn_read_float(buf, AT, PNANOVDB_REF(ijk))", "float"),
}


def _element(kind, address, e):
    read, size = _ELEMENTS[kind]
    return read.replace("AT", f"pnanovdb_address_offset({address}, {size * e}u)")


def _in_leaf(name, kind, e):
    """C++ for element e of voxel n, which is at ijk, of ``leaf``."""
    table = f"pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_{name}, buf, leaf, "
    if kind in _CODED:
        return _CODED[kind][0].replace("AT", table + "0u)")
    return _element(kind, table + "n)", e)


def _reader(family, components):
    """C++ that returns the voxel (i, j, k), which is in ``node``."""
    shape, target = ("double", "result") if components == 1 else (f"wp::vec_t<{components}, double>", "result[{e}]")
    cases = []
    for name, kind in family.items():
        whole = _CODED[kind][1] if kind in _CODED else kind
        assignments = " ".join(
            f"{target.format(e=e)} = inside ? (double)({_in_leaf(name, kind, e)})"
            f" : (double)({_element(whole, 'at', e)});"
            for e in range(components)
        )
        cases.append(f"case PNANOVDB_GRID_TYPE_{name}: {assignments} break;")
    # A type of another family gives no number at all.
    none = " ".join(f"{target.format(e=e)} = (double)NAN;" for e in range(components))
    switch = "\n".join(["switch (grid_type) {", *cases, f"default: {none}", "}"])
    return f"""
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const bool inside = (node & 1u) != 0u;
    const pnanovdb_address_t at = {{ node & ~1ull }};
    const pnanovdb_leaf_handle_t leaf = {{ at }};
    const pnanovdb_coord_t ijk = {{ i, j, k }};
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    wp::half half;
    {shape} result;
    {switch}
    return result;
    """


_TYPE_SNIPPET = "return (int)wp::volume::get_grid_type(wp::volume::id_to_buffer(volume));"

# Leaves are told from values by the lowest bit, which no address has.
_NODE_SNIPPET = """
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = { i, j, k };
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    unsigned level;
    const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
        (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    return level == 0u ? accessor.leaf.address.byte_offset | 1u : at.byte_offset;
"""

_FLOAT_LEAF_CELL_SNIPPET = """
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_leaf_handle_t leaf = { node & ~1ull };
    const pnanovdb_coord_t ijk = { i, j, k };
    const unsigned n = pnanovdb_leaf_coord_to_offset(PNANOVDB_REF(ijk));
    wp::vec_t<8, double> result;
    for (unsigned c = 0u; c < 8u; ++c) {
        const unsigned step = ((c & 4u) << 4) + ((c & 2u) << 2) + (c & 1u);
        result[c] = (double)pnanovdb_read_float(
            buf, pnanovdb_leaf_get_table_address(PNANOVDB_GRID_TYPE_FLOAT, buf, leaf, n + step));
    }
    return result;
"""


@wp.func_native(_TYPE_SNIPPET)
def grid_type_of(volume: wp.uint64) -> int:
    """NanoVDB's number of the grid's value type."""
    ...


@wp.func_native(_NODE_SNIPPET)
def node_of(volume: wp.uint64, grid_type: int, i: int, j: int, k: int) -> wp.uint64:
    """The leaf that holds a voxel, or the tile or background that stands for it, for read_voxel."""
    ...


@wp.func
def is_leaf(node: wp.uint64) -> bool:
    return (node & wp.uint64(1)) != wp.uint64(0)


# One overload for each family of value types: which one is meant shows in the type of the last argument.
@wp.func_native(_reader(_SCALARS, 1))
def read_voxel(
    volume: wp.uint64, grid_type: int, node: wp.uint64, i: int, j: int, k: int, family: wp.float64
) -> wp.float64:
    """The value of a voxel, by the node that node_of found for it."""
    ...


@wp.func_native(_reader(_VECTORS_3, 3))
def read_voxel(  # noqa: F811
    volume: wp.uint64, grid_type: int, node: wp.uint64, i: int, j: int, k: int, family: wp.vec3d
) -> wp.vec3d: ...


@wp.func_native(_reader(_VECTORS_4, 4))
def read_voxel(  # noqa: F811
    volume: wp.uint64, grid_type: int, node: wp.uint64, i: int, j: int, k: int, family: wp.vec4d
) -> wp.vec4d: ...


@wp.func_native(_FLOAT_LEAF_CELL_SNIPPET)
def read_float_leaf_cell(volume: wp.uint64, node: wp.uint64, i: int, j: int, k: int) -> vec8d:
    """The voxels (i, j, k) to (i + 1, j + 1, k + 1), k fastest, of a float grid, all of them in one leaf."""
    ...


@wp.func
def read_separate(volume: wp.uint64, kind: int, n000: wp.uint64, i: int, j: int, k: int, family: Any):
    """As read_cell, by the node of the first voxel; the others share it where no border is between them."""
    x = (i & 7) == 7
    y = (j & 7) == 7
    z = (k & 7) == 7
    n001 = n000
    n010 = n000
    n100 = n000
    if z:
        n001 = node_of(volume, kind, i, j, k + 1)
    if y:
        n010 = node_of(volume, kind, i, j + 1, k)
    if x:
        n100 = node_of(volume, kind, i + 1, j, k)
    n011 = n001
    n101 = n001
    n110 = n010
    if y:
        n011 = n010
        if z:
            n011 = node_of(volume, kind, i, j + 1, k + 1)
    if x:
        n101 = n100
        n110 = n100
        if z:
            n101 = node_of(volume, kind, i + 1, j, k + 1)
        if y:
            n110 = node_of(volume, kind, i + 1, j + 1, k)
    n111 = n011
    if x:
        n111 = n101
        if y:
            n111 = n110
            if z:
                n111 = node_of(volume, kind, i + 1, j + 1, k + 1)
    return (
        read_voxel(volume, kind, n000, i, j, k, family),
        read_voxel(volume, kind, n001, i, j, k + 1, family),
        read_voxel(volume, kind, n010, i, j + 1, k, family),
        read_voxel(volume, kind, n011, i, j + 1, k + 1, family),
        read_voxel(volume, kind, n100, i + 1, j, k, family),
        read_voxel(volume, kind, n101, i + 1, j, k + 1, family),
        read_voxel(volume, kind, n110, i + 1, j + 1, k, family),
        read_voxel(volume, kind, n111, i + 1, j + 1, k + 1, family),
    )


@wp.func
def read_cell(volume: wp.uint64, i: int, j: int, k: int, family: wp.float64):
    """The eight voxels (i, j, k) to (i + 1, j + 1, k + 1), k fastest."""
    kind = grid_type_of(volume)
    node = node_of(volume, kind, i, j, k)
    # Two thirds of all cells are in one leaf: this path makes float grids 1.2 times as fast.
    if kind == FLOAT_TYPE and is_leaf(node) and (i & 7) < 7 and (j & 7) < 7 and (k & 7) < 7:
        c = read_float_leaf_cell(volume, node, i, j, k)
        return c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7]
    return read_separate(volume, kind, node, i, j, k, family)


@wp.func
def read_cell(volume: wp.uint64, i: int, j: int, k: int, family: Any):  # noqa: F811
    kind = grid_type_of(volume)
    return read_separate(volume, kind, node_of(volume, kind, i, j, k), i, j, k, family)
