"""Which blocks of 8^3 cells may hold a crossing of an isovalue, and which of their cells.

Of a level set a ray then touches 128 bytes for each block near the surface, in place of the two kilobytes of a leaf and
those of its neighbours, and the tree not at all.

- reach: for each block of the box around what is stored, x slowest, and for a rim of one block around it, how many
  blocks ahead the nearest is that may hold a crossing (the largest of the three coordinates' differences); 0 for such a
  block itself, -1 in the rim. Eight times: ahead of rays of each octant, 4, 2 and 1 for backwards along x, y and z. One
  byte each: it is all that rays look at on most of their way.
- numbers: which one of `blocks` a block is.
- first_block, block_count: the first block, relative to the anchor voxel, in blocks, and how many there are.
- blocks: BLOCK_WORDS words for each busy block: for each x the bits 8 y + z of the cells that may hold a crossing, then
  the leaves, marked by their lowest bit, or tiles of the block and of the seven beside it, z fastest.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.cached_accessor_kernels import BLOCK_WORDS, TREE, tree_text

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

__all__ = ["BLOCK_WORDS"]

# Distances [blocks] are not told apart beyond this: the first steps gain the most.
FARTHEST = wp.constant(32)

# The cells of a block see the voxels of the block and the first layer of the seven blocks above it. The bit of a block
# or a cell is 0 only where all of these are on the same side of the isovalue: NaN and the isovalue itself are on none.
_MARK = (
    TREE
    + """
    (void)background;
    auto look = [&](address node, int x, int y, int z, int nx, int ny, int nz, bool& over, bool& under) {
        for (int i = 0; i < nx && (over || under); ++i)
            for (int j = 0; j < ny; ++j)
                for (int k = 0; k < nz; ++k) {
                    const real v = voxel(node, x + i, y + j, z + k);
                    over = over & (v > (real)below);
                    under = under & (v < (real)above);
                }
    };
    const int row_x = row / block_count[1], row_y = row % block_count[1];
    const bool rim = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
    const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
    int* out = out_busy.data + (address)row * block_count[2];
    // The scan that follows has one number more than there are blocks.
    if (row == 0) out_busy.data[(address)block_count[0] * block_count[1] * block_count[2]] = 0;
    for (int n = 0; n < block_count[2]; ++n) {
        const int z = 8 * (first_block[2] + n);
        bool over = true, under = true;
        for (int m = 0; m < 8 && (over || under) && !rim && n > 0 && n < block_count[2] - 1; ++m) {
            const int i = x + 2 * (m & 4), j = y + 4 * (m & 2), k = z + 8 * (m & 1);
            const address node = find(i, j, k, ignored);
            if (!(node & 1)) look(node, i, j, k, 1, 1, 1, over, under);
            else if (m == 0) look(node, i, j, k, 8, 8, 8, over, under);
            else look(node, i, j, k, m & 4 ? 1 : 8, m & 2 ? 1 : 8, m & 1 ? 1 : 8, over, under);
        }
        out[n] = over || under ? 0 : 1;
    }
"""
)
_WRITE = (
    TREE
    + """
    (void)background;
    const int row_x = row / block_count[1], row_y = row % block_count[1];
    const bool rim = row_x == 0 || row_y == 0 || row_x == block_count[0] - 1 || row_y == block_count[1] - 1;
    const int x = 8 * (first_block[0] + row_x), y = 8 * (first_block[1] + row_y);
    for (int n = 0; n < block_count[2]; ++n) {
        const address at = (address)row * block_count[2] + n;
        const int own = numbers.data[at];
        if (numbers.data[at + 1] == own) {
            out_distance.data[at] = rim || n == 0 || n == block_count[2] - 1 ? -1 : FARTHEST;
            continue;
        }
        out_distance.data[at] = 0;
        const int z = 8 * (first_block[2] + n);
        unsigned long long* block = (unsigned long long*)out_blocks.data + BLOCK_WORDS * (address)own;
        for (int m = 0; m < 8; ++m) block[8 + m] = find(x + 2 * (m & 4), y + 4 * (m & 2), z + 8 * (m & 1), ignored);
        // Bit k of a line is its voxel k along z; two layers of nine lines.
        unsigned over[2][9], under[2][9];
        for (int i = 0; i < 9; ++i) {
            for (int j = 0; j < 9; ++j) {
                unsigned o = 0, u = 0;
                const address* nodes = (const address*)block + 8 + (i >> 3 << 2 | j >> 3 << 1);
                for (int k = 0; k < 8; ++k) {
                    const real v = voxel(nodes[0], x + i, y + j, z + k);
                    o |= (v > (real)below ? 1u : 0u) << k;
                    u |= (v < (real)above ? 1u : 0u) << k;
                }
                const real v = voxel(nodes[1], x + i, y + j, z + 8);
                over[i & 1][j] = o | (v > (real)below ? 1u : 0u) << 8;
                under[i & 1][j] = u | (v < (real)above ? 1u : 0u) << 8;
            }
            if (i == 0) continue;
            unsigned long long cells = 0;
            for (int j = 0; j < 8; ++j) {
                const unsigned o = over[0][j] & over[0][j + 1] & over[1][j] & over[1][j + 1];
                const unsigned u = under[0][j] & under[0][j + 1] & under[1][j] & under[1][j + 1];
                cells |= (unsigned long long)(~(o & o >> 1 | u & u >> 1) & 255u) << 8 * j;
            }
            block[i - 1] = cells;
        }
    }
"""
).replace("FARTHEST", str(int(FARTHEST)))

# A line of blocks along z of those that spread_distance_kernel writes: byte by byte, which a CPU does for many at once.
# Seen without a sign the rim is far away.
_SPREAD = """
    typedef unsigned char byte;
    const int lines = total / length, part = line / lines, first = (line - part * lines) * length;
    const byte* const in = (const byte*)distance.data + (long long)(part >> 1) * total + first;
    byte* const out = (byte*)out_distance.data + (long long)part * total + first;
    const bool back = part & 1;
    for (int k = 0; k < length; ++k) out[k] = in[k];
    auto see = [](byte* to, const byte* from, int r, int n) {
        for (int k = 0; k < n; ++k) {
            const byte other = from[k] > (byte)r ? from[k] : (byte)r;
            to[k] = to[k] < other ? to[k] : other;
        }
    };
    const int i = first / stride % count, ahead = stride == 1 ? length - 1 : back ? i : count - 1 - i;
    const long long step = back ? -(long long)stride : (long long)stride;
    for (int r = 1; r < FARTHEST && r <= ahead; ++r) {
        if (stride > 1) see(out, in + r * step, r, length);
        else if (back) see(out + r, in, r, length - r);
        else see(out, in + r, r, length - r);
    }
    for (int k = 0; k < length; ++k) out[k] = in[k] == 255 ? in[k] : out[k];
""".replace("FARTHEST", str(int(FARTHEST)))


@wp.func_native(tree_text(_MARK, "float"))
def mark_float_row(
    row: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    out_busy: wp.array(dtype=int),
): ...


@wp.func_native(tree_text(_MARK, "scalar"))
def mark_scalar_row(
    row: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    out_busy: wp.array(dtype=int),
): ...


@wp.func_native(tree_text(_WRITE, "float"))
def write_float_row(
    row: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    numbers: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.int8),
    out_blocks: wp.array(dtype=wp.uint64),
): ...


@wp.func_native(tree_text(_WRITE, "scalar"))
def write_scalar_row(
    row: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    numbers: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.int8),
    out_blocks: wp.array(dtype=wp.uint64),
): ...


@wp.kernel
def mark_float_blocks_kernel(
    first: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    out_busy: wp.array(dtype=int),
):
    mark_float_row(first + wp.tid(), volume, anchor, first_block, block_count, below, above, out_busy)


@wp.kernel
def mark_scalar_blocks_kernel(
    first: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    out_busy: wp.array(dtype=int),
):
    mark_scalar_row(first + wp.tid(), volume, anchor, first_block, block_count, below, above, out_busy)


@wp.kernel
def write_float_blocks_kernel(
    first: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    numbers: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.int8),
    out_blocks: wp.array(dtype=wp.uint64),
):
    write_float_row(
        first + wp.tid(),
        volume,
        anchor,
        first_block,
        block_count,
        below,
        above,
        numbers,
        out_distance,
        out_blocks,
    )


@wp.kernel
def write_scalar_blocks_kernel(
    first: int,
    volume: wp.uint64,
    anchor: wp.vec3i,
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    below: wp.float64,
    above: wp.float64,
    numbers: wp.array(dtype=int),
    out_distance: wp.array(dtype=wp.int8),
    out_blocks: wp.array(dtype=wp.uint64),
):
    write_scalar_row(
        first + wp.tid(),
        volume,
        anchor,
        first_block,
        block_count,
        below,
        above,
        numbers,
        out_distance,
        out_blocks,
    )


@wp.kernel
def spread_distance_kernel(
    first: int,
    total: int,
    stride: int,
    count: int,
    distance: wp.array(dtype=wp.int8),
    out_distance: wp.array(dtype=wp.int8),
):
    """Distances by one more axis: its blocks are ``stride`` numbers apart, ``count`` of them in a line.

    Each ``total`` of them become twice as many: those forwards along the axis, and those backwards.
    """
    k = first + wp.tid()
    part = k // total
    n = k - part * total
    at = (part // 2) * total + n
    best = int(distance[at])
    if best > 0:
        i = (n // stride) % count
        room = count - 1 - i
        step = stride
        if part % 2 == 1:
            room = i
            step = -stride
        r = int(1)
        while r < best and r <= room:
            at += step
            other = int(distance[at])
            if other >= 0:
                best = wp.min(best, wp.max(r, other))
            r += 1
    out_distance[k] = wp.int8(best)


@wp.func_native(_SPREAD)
def spread_line(
    line: int,
    total: int,
    stride: int,
    count: int,
    length: int,
    distance: wp.array(dtype=wp.int8),
    out_distance: wp.array(dtype=wp.int8),
): ...


@wp.kernel
def spread_lines_kernel(
    first: int,
    total: int,
    stride: int,
    count: int,
    length: int,
    distance: wp.array(dtype=wp.int8),
    out_distance: wp.array(dtype=wp.int8),
):
    """As spread_distance_kernel; an item is a line of ``length`` blocks along z."""
    spread_line(first + wp.tid(), total, stride, count, length, distance, out_distance)
