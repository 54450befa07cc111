"""Which voxels lie inside an isosurface, which cells it crosses, and where these find their neighbours.

A cell has its number from its lowest voxel and belongs to the block of 8^3 cells that starts where the leaf of that
voxel does. Signs travel as bits: plane x of a block is a word of 64 voxels whose bit ``8 y + z`` says "inside", so that
shifted words compare the voxels of 64 cells at once. Only what reads values depends on their type.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.read_voxel_kernels import grid_type_of, node_of, read_voxel

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Words of a plane's record: cells with at least 1, 2, 3 and 4 sheets of the surface.
RECORD = 4
# A leaf's mask of active voxels follows its box and flags, whatever the type.
LEAF_MASK = 16
# A lower node's masks: of active tiles after its box and flags, of children after that.
LOWER_MASK = 32
LOWER_CHILDREN = 544
# What stands for a leaf that does not exist: -1 - (inside + 2 * active).
INSIDE_TILE, ACTIVE_TILE = wp.constant(1), wp.constant(2)


@wp.struct
class Cells:
    """The blocks that a surface may cross: the leaves, then blocks of tiles beside them ("rims")."""

    volume: wp.uint64  # address of the grid
    values: wp.uint64  # address of the first leaf's values, float32
    stride: wp.uint64  # bytes from a leaf's values to the next one's
    isovalue: wp.float64  # what the float32 values are compared with
    leaf_count: int
    leaf_offset: wp.array(dtype=wp.uint64)  # of each leaf from the grid's start
    origin: wp.array(dtype=wp.vec3i)  # first voxel of each block
    sides: wp.array(dtype=wp.uint64)  # 8 planes a block: inside voxels
    rim_active: wp.array(dtype=wp.uint8)  # of each rim
    refs: wp.array(dtype=int)  # 8 a block: the blocks at + (dx, dy, dz), number 4 dx + 2 dy + dz; tiles negative
    crossed: wp.array(dtype=int)  # blocks with crossed cells
    slot: wp.array(dtype=int)  # of each block in `crossed`, or -1


@wp.struct
class Tree:
    """Lower nodes with what stands beside them, for walks from leaf to leaf without the root."""

    begin: wp.uint64  # of the lower nodes from the grid's start
    size: wp.uint64  # bytes of a lower node
    table: wp.uint64  # of the slots from a lower node
    leaf_begin: wp.uint64
    leaf_size: wp.uint64  # 0 where leaves differ in size
    tile_inside: wp.array(dtype=wp.uint64)  # 64 words a lower node: tiles that lie inside
    around: wp.array(dtype=int)  # 27 a lower node: lower nodes, tiles negative
    leaf_lower: wp.array(dtype=int)  # of each leaf
    leaf_slot: wp.array(dtype=int)


# Names that the text expects: cells. Bits of a word are counted and found as the device can.
BITS = """
    typedef unsigned long long u64;
    #ifdef __CUDA_ARCH__
    auto count_bits = [](u64 w) { return __popcll(w); };
    auto first_bit = [](u64 w) { return __ffsll((long long)w) - 1; };
    #else
    auto count_bits = [](u64 w) { return __builtin_popcountll(w); };
    auto first_bit = [](u64 w) { return __builtin_ctzll(w); };
    #endif
"""

# Names that the text expects: cells.
PLANES = f"""
    {BITS}
    // Plane x of the voxels of a block or tile.
    auto inside_plane = [&](int ref, int x) -> u64 {{
        if (ref >= 0) return cells.sides.data[8ll * ref + x];
        return (-1 - ref) & 1 ? ~0ull : 0ull;
    }};
    auto active_plane = [&](int ref, int x) -> u64 {{
        if (ref < 0) return (-1 - ref) & 2 ? ~0ull : 0ull;
        if (ref >= cells.leaf_count) return cells.rim_active.data[ref - cells.leaf_count] ? ~0ull : 0ull;
        return *(const u64*)(cells.volume + cells.leaf_offset.data[ref] + {LEAF_MASK} + 8 * x);
    }};
    // Voxels (x, y, z), (x, y, z + 1), (x, y + 1, z) and (x, y + 1, z + 1) of the 64 cells of plane x, x up to 8.
    auto corners = [&](const int* refs, int x, auto plane, u64* out) {{
        const int* column = refs + (x == 8 ? 4 : 0);
        x &= 7;
        const u64 own = plane(column[0], x), above = plane(column[1], x);
        const u64 beside = (own >> 8) | (plane(column[2], x) << 56);
        const u64 both = (above >> 8) | (plane(column[3], x) << 56);
        const u64 inner = 0x7f7f7f7f7f7f7f7full;
        out[0] = own;
        out[1] = ((own >> 1) & inner) | ((above << 7) & ~inner);
        out[2] = beside;
        out[3] = ((beside >> 1) & inner) | ((both << 7) & ~inner);
    }};
    // The corners of one cell that are inside, as bits.
    auto case_of = [](const u64* inside, int bit) -> int {{
        #ifdef __CUDA_ARCH__
        int code = 0;
        for (int c = 0; c < 8; ++c) code |= (int)(inside[c] >> bit & 1u) << c;
        return code;
        #else
        typedef u64 w8 __attribute__((ext_vector_type(8), aligned(8)));
        typedef bool b8 __attribute__((ext_vector_type(8)));
        const w8 chosen = *(const w8*)inside & (1ull << bit);
        return __builtin_bit_cast(unsigned char, __builtin_convertvector(chosen != 0ull, b8));
        #endif
    }};
"""

_LEAF_SIDES_SNIPPET = """
    const float* value = (const float*)(cells.values + cells.stride * (unsigned long long)leaf);
    unsigned long long* out = cells.sides.data + 8ll * leaf;
    #if defined(__CUDA_ARCH__)
    for (int x = 0; x < 8; ++x) {
        unsigned long long word = 0;
        for (int n = 0; n < 64; ++n) word |= (unsigned long long)(value[64 * x + n] < limit) << n;
        out[x] = word;
    }
    #else
    typedef float v16 __attribute__((ext_vector_type(16), aligned(4)));
    typedef bool b16 __attribute__((ext_vector_type(16)));
    unsigned short* part = (unsigned short*)out;
    for (int n = 0; n < 32; ++n) {
        part[n] = __builtin_bit_cast(unsigned short, __builtin_convertvector(((const v16*)value)[n] < limit, b16));
    }
    #endif
"""

_ROW_SIDES_SNIPPET = """
    const float* value = (const float*)(cells.values + cells.stride * (unsigned long long)(row >> 6)) + 8 * (row & 63);
    unsigned char bits = 0;
    for (int z = 0; z < 8; ++z) bits |= (unsigned char)(value[z] < limit) << z;
    ((unsigned char*)cells.sides.data)[row] = bits;
"""

_LOWER_AT_SNIPPET = """
    // The lower node at a voxel: its number; or the address of the tile that stands for it, as -1 - address.
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = { i, j, k };
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    unsigned level;
    const pnanovdb_address_t at = pnanovdb_readaccessor_get_value_address_and_level(
        (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk), PNANOVDB_REF(level));
    if (level <= 1u) return (long long)((accessor.lower.address.byte_offset - tree.begin) / tree.size);
    return -1ll - (long long)at.byte_offset;
"""

_IS_ACTIVE_SNIPPET = """
    const pnanovdb_buf_t buf = wp::volume::id_to_buffer(volume);
    const pnanovdb_coord_t ijk = { i, j, k };
    pnanovdb_readaccessor_t accessor;
    pnanovdb_readaccessor_init(PNANOVDB_REF(accessor), wp::volume::get_root(buf));
    return (bool)pnanovdb_readaccessor_is_active(
        (pnanovdb_grid_type_t)grid_type, buf, PNANOVDB_REF(accessor), PNANOVDB_REF(ijk));
"""

# Names that the text expects: cells, tree.
_LEAF_INDEX = """
    // Number of the leaf at an offset from the grid's start.
    auto leaf_index = [&](unsigned long long offset) -> int {
        if (tree.leaf_size) return (int)((unsigned)((offset - tree.leaf_begin) >> 5) / (unsigned)(tree.leaf_size >> 5));
        int low = 0, high = cells.leaf_count - 1;
        while (low < high) {
            const int middle = (low + high) / 2;
            if (cells.leaf_offset.data[middle] < offset) low = middle + 1; else high = middle;
        }
        return low;
    };
"""

# Names that the text expects: cells, tree, lower, slot; `found(number, ref)` gets what stands at each of the 27 places.
AROUND = f"""
    typedef unsigned long long u64;
    {_LEAF_INDEX}
    // Of the 27 blocks around: tiles inside and outside. Block (dx, dy, dz) is number 13 + 9 dx + 3 dy + dz.
    unsigned in_tiles = 0u, out_tiles = 0u;
    auto look_around = [&](int* refs) {{
        const int place[3] = {{ slot >> 8, slot >> 4 & 15, slot & 15 }};
        for (int dx = -1, number = 0; dx <= 1; ++dx)
        for (int dy = -1; dy <= 1; ++dy)
        for (int dz = -1; dz <= 1; ++dz, ++number) {{
            const int x = place[0] + dx, y = place[1] + dy, z = place[2] + dz;
            const int node = tree.around.data[27ll * lower + 9 * ((x >> 4) + 1) + 3 * ((y >> 4) + 1) + (z >> 4) + 1];
            const int at = (x & 15) << 8 | (y & 15) << 4 | (z & 15);
            const bool above = refs && dx >= 0 && dy >= 0 && dz >= 0;
            int ref = node;
            if (node >= 0) {{
                const u64 start = tree.begin + tree.size * (u64)node;
                const u64 bytes = cells.volume + start;
                if (((const unsigned char*)bytes)[{LOWER_CHILDREN} + (at >> 3)] >> (at & 7) & 1) {{
                    ref = above ? leaf_index(start + *(const u64*)(bytes + tree.table + 8 * at)) : 0;
                }} else {{
                    const int inside = (int)(tree.tile_inside.data[64ll * node + (at >> 6)] >> (at & 63) & 1u);
                    const int active = ((const unsigned char*)bytes)[{LOWER_MASK} + (at >> 3)] >> (at & 7) & 1;
                    ref = -1 - (inside | active << 1);
                }}
            }}
            if (ref < 0) ((-1 - ref) & 1 ? in_tiles : out_tiles) |= 1u << number;
            if (above) refs[4 * dx + 2 * dy + dz] = ref;
        }}
    }};
    // Whether the block 13 - 9 ex - 3 ey - ez is a tile of which some cell may be crossed. Such a cell has two corners
    // that differ, so that among the 8 blocks that it may reach, tiles differ from each other or from voxels of a leaf;
    // each leaf looks at its own voxels only.
    auto is_rim = [&](int e, bool some_in, bool some_out) -> bool {{
        const int block = 13 - 9 * (e >> 2) - 3 * (e >> 1 & 1) - (e & 1);
        // The block itself and the seven above it.
        const unsigned reached = 0x361bu << block;
        return ((in_tiles | out_tiles) >> block & 1u) && (some_in || in_tiles & reached)
            && (some_out || out_tiles & reached);
    }};
"""

_LINK_SNIPPET = f"""
    const int lower = tree.leaf_lower.data[leaf], slot = tree.leaf_slot.data[leaf];
    {AROUND}
    look_around(cells.refs.data + 8ll * leaf);
    const u64* own = cells.sides.data + 8ll * leaf;
    u64 any = 0, all = ~0ull;
    for (int x = 0; x < 8; ++x) {{ any |= own[x]; all &= own[x]; }}
    int rims = 0;
    for (int e = 1; e < 8; ++e) {{
        // The leaf's voxels that cells of the block below reach.
        const u64 column = (e & 2 ? 0xffull : ~0ull) & (e & 1 ? 0x0101010101010101ull : ~0ull);
        if (is_rim(e, (e & 4 ? own[0] : any) & column, ~(e & 4 ? own[0] : all) & column)) rims |= 1 << e;
    }}
    return rims;
"""

_LEAF_AT_SNIPPET = f"""
    {_LEAF_INDEX}
    return leaf_index(node & ~1ull);
"""

_MIXED_SNIPPET = f"""
    {PLANES}
    const int* refs = cells.refs.data + 8ll * block;
    u64 any = 0, all = ~0ull, side[4];
    for (int x = 0; x < 8; ++x) {{
        const u64 word = cells.sides.data[8ll * block + x];
        any |= word;
        all &= word;
    }}
    if (any && ~all) return true;
    // All voxels of the block are alike: what follows them above decides.
    for (int x = 7; x < 9; ++x) {{
        corners(refs, x, inside_plane, side);
        for (int c = 0; c < 4; ++c) {{ any |= side[c]; all &= side[c]; }}
    }}
    for (int x = 0; x < 7; ++x) {{
        corners(refs, x, inside_plane, side);
        for (int c = 0; c < 4; ++c) {{ any |= side[c]; all &= side[c]; }}
    }}
    return any && ~all;
"""


@wp.func_native(_LEAF_SIDES_SNIPPET)
def leaf_sides(cells: Cells, leaf: int, limit: wp.float32):
    """The eight planes of a leaf: voxels below the limit."""
    ...


@wp.func_native(_ROW_SIDES_SNIPPET)
def row_sides(cells: Cells, row: int, limit: wp.float32):
    """Eight voxels of a leaf: a byte of a plane."""
    ...


@wp.func_native(_LOWER_AT_SNIPPET)
def lower_at(volume: wp.uint64, grid_type: int, tree: Tree, i: int, j: int, k: int) -> wp.int64: ...


@wp.func_native(_IS_ACTIVE_SNIPPET)
def is_active(volume: wp.uint64, grid_type: int, i: int, j: int, k: int) -> bool: ...


@wp.func_native(_LINK_SNIPPET)
def link_leaf(cells: Cells, tree: Tree, leaf: int) -> int:
    """Finds the blocks above a leaf; returns the tiles below it that may have crossed cells, as bits by direction."""
    ...


@wp.func_native(_LEAF_AT_SNIPPET)
def leaf_at(cells: Cells, tree: Tree, node: wp.uint64) -> int:
    """The number of a leaf that node_of has found."""
    ...


@wp.func_native(_MIXED_SNIPPET)
def is_mixed(cells: Cells, block: int) -> bool:
    """Whether the corners of a block's cells are not all on the same side."""
    ...


@wp.func
def value_at(volume: wp.uint64, i: int, j: int, k: int) -> wp.float64:
    kind = grid_type_of(volume)
    return read_voxel(volume, kind, node_of(volume, kind, i, j, k), i, j, k, wp.float64(0.0))


@wp.func
def tile_ref(volume: wp.uint64, isovalue: wp.float64, i: int, j: int, k: int) -> int:
    """What stands for a tile: by its value and state."""
    code = 0
    if value_at(volume, i, j, k) < isovalue:
        code += INSIDE_TILE
    if is_active(volume, grid_type_of(volume), i, j, k):
        code += ACTIVE_TILE
    return -1 - code


@wp.kernel
def leaf_sides_kernel(first: int, cells: Cells, limit: wp.float32):
    leaf_sides(cells, first + wp.tid(), limit)


@wp.kernel
def row_sides_kernel(first: int, cells: Cells, limit: wp.float32):
    row_sides(cells, first + wp.tid(), limit)


@wp.kernel
def decode_kernel(first: int, cells: Cells, isovalue: wp.float64, out_value: wp.array(dtype=wp.float32)):
    """Rows of eight voxels of any type, minus the isovalue, and which of them are inside."""
    row = first + wp.tid()
    leaf = row / 64
    volume = cells.volume
    kind = grid_type_of(volume)
    node = cells.leaf_offset[leaf] + wp.uint64(1)
    corner = cells.origin[leaf]
    i = corner[0] + (row % 64) / 8
    j = corner[1] + row % 8
    for z in range(8):
        value = read_voxel(volume, kind, node, i, j, corner[2] + z, wp.float64(0.0)) - isovalue
        out_value[8 * row + z] = wp.float32(value)


@wp.kernel
def tile_sides_kernel(
    first: int, volume: wp.uint64, isovalue: wp.float64, tree: Tree, out_inside: wp.array(dtype=wp.uint64)
):
    word = first + wp.tid()
    kind = grid_type_of(volume)
    at = tree.begin + tree.size * wp.uint64(word / 64) + tree.table + wp.uint64((word % 64) * 512)
    bits = wp.uint64(0)
    for n in range(64):
        # Slots that lead to a leaf give bits that nobody asks for.
        if read_voxel(volume, kind, at + wp.uint64(8 * n), 0, 0, 0, wp.float64(0.0)) < isovalue:
            bits = bits | (wp.uint64(1) << wp.uint64(n))
    out_inside[word] = bits


@wp.kernel
def lower_neighbors_kernel(
    first: int,
    volume: wp.uint64,
    isovalue: wp.float64,
    tree: Tree,
    lower_origin: wp.array(dtype=wp.vec3i),
    out_around: wp.array(dtype=int),
):
    item = first + wp.tid()
    corner = lower_origin[item / 27]
    side = item % 27
    i = corner[0] + 128 * (side / 9 - 1)
    j = corner[1] + 128 * ((side / 3) % 3 - 1)
    k = corner[2] + 128 * (side % 3 - 1)
    node = lower_at(volume, grid_type_of(volume), tree, i, j, k)
    if node >= wp.int64(0):
        out_around[item] = int(node)
    else:
        out_around[item] = tile_ref(volume, isovalue, i, j, k)


@wp.kernel
def link_kernel(
    first: int,
    cells: Cells,
    tree: Tree,
    out_rims: wp.array(dtype=wp.uint8),
    out_some: wp.array(dtype=int),
    out_mixed: wp.array(dtype=int),
):
    """Blocks above each leaf, and the tiles below it that may have crossed cells; whether any leaf has some.

    Without these, out_mixed is what mixed_kernel says.
    """
    leaf = first + wp.tid()
    rims = link_leaf(cells, tree, leaf)
    out_rims[leaf] = wp.uint8(rims)
    if rims != 0:
        out_some[0] = 1
    out_mixed[leaf] = int(is_mixed(cells, leaf))


@wp.kernel
def mixed_kernel(first: int, cells: Cells, out_mixed: wp.array(dtype=int)):
    block = first + wp.tid()
    out_mixed[block] = int(is_mixed(cells, block))


@wp.kernel
def list_kernel(
    first: int,
    mixed: wp.array(dtype=int),
    place: wp.array(dtype=int),
    out_crossed: wp.array(dtype=int),
    out_slot: wp.array(dtype=int),
):
    block = first + wp.tid()
    if mixed[block] != 0:
        out_crossed[place[block]] = block
        out_slot[block] = place[block]
    else:
        out_slot[block] = -1


@wp.kernel
def totals_kernel(
    first: int,
    counts: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    more_counts: wp.array(dtype=int),
    more_starts: wp.array(dtype=int),
    out_totals: wp.array(dtype=int),
):
    """Sums of all counts, from where the last one starts; of one kind or of two."""
    kind = first + wp.tid()
    last = counts.shape[0] - 1
    if kind == 0:
        out_totals[kind] = starts[last] + counts[last]
    else:
        out_totals[kind] = more_starts[last] + more_counts[last]
