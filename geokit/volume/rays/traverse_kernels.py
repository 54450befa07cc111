"""C++ text of a walk along a ray through the cells of a NanoVDB grid: what is constant is crossed in one step.

A cell is the cube between eight voxel centres, named by its lowest voxel; the cells of an aligned block of 8^3 need the
voxels of up to eight blocks.
"""

from geokit.volume.nanovdb.cached_accessor_kernels import TREE, tree_text

# Names that the text expects: those of TREE; lower and upper (double: the box outside of which all is background),
# start and toward (double, index space relative to the anchor; the largest component of toward is 1), t_first and
# t_last (units of toward); reach, numbers, first_block, block_count and blocks, see crossing_blocks_kernels.
# The arguments of `traversal` may use: `real`, the type of voxels; `background`; `entered`, whether the ray comes from
# outside the box; `left`, whether it leaves it before t_last.
# - START runs where the ray enters the box, at t0.
# - SAME(a, b): whether blocks of these values, side by side, can be crossed in one step.
# - ON_REGION: the value of the interpolant is that of `value`, up to SAME, between ta and tb.
# - ON_CELL: the ray is between ta and tb in the cell (x, y, z), whose voxels are c[0] to c[7], k fastest; `mixed` where
#   these are known not to be all above or all below the isovalue. `unseen` is -1, or the number of a voxel of the face
#   through which the ray came out of blocks or cells that it crossed unseen.
# - END runs at t0 + last, where the box or the ray ends.
# The hooks end the walk by `goto done`.

# Where the ray enters the box, and how far it goes; without branches, so that it does for several rays at once.
SET_UP = """
    const double qx0 = start[0], qy0 = start[1], qz0 = start[2];
    // So small a component moves the ray by less than 2^-60 voxels within the range of int32.
    const double dx = wp::abs(toward[0]) < 1e-30 ? 0.0 : toward[0], dy = wp::abs(toward[1]) < 1e-30 ? 0.0 : toward[1],
                 dz = wp::abs(toward[2]) < 1e-30 ? 0.0 : toward[2];
    // A component of zero gets a reciprocal that puts borders out of reach.
    const double ix = dx == 0.0 ? 1e300 : 1.0 / dx, iy = dy == 0.0 ? 1e300 : 1.0 / dy,
                 iz = dz == 0.0 ? 1e300 : 1.0 / dz;
    const int sx = dx < 0.0 ? -1 : 1, sy = dy < 0.0 ? -1 : 1, sz = dz < 0.0 ? -1 : 1;
    const int fx = sx > 0 ? 1 : 0, fy = sy > 0 ? 1 : 0, fz = sz > 0 ? 1 : 0;
    double t0 = t_first, t1 = t_last;
    auto clip = [&](double at, double d, double inverse, double low, double high) {
        const double one = (low - at) * inverse, other = (high - at) * inverse;
        const double begin = wp::max(t0, wp::min(one, other)), end = wp::min(t1, wp::max(one, other));
        const bool beside = !(at >= low && at <= high);
        t0 = d == 0.0 ? t0 : begin;
        t1 = d != 0.0 ? end : beside ? -(double)INFINITY : t1;
    };
    clip(qx0, dx, ix, lower[0], upper[0]);
    clip(qy0, dy, iy, lower[1], upper[1]);
    clip(qz0, dz, iz, lower[2], upper[2]);
    // A number minus itself is zero, unless it is infinite or none.
    const double none = (qx0 - qx0) + (qy0 - qy0) + (qz0 - qz0) + (dx - dx) + (dy - dy) + (dz - dz);
    bool crosses = t0 <= t1 && t0 < (double)INFINITY && lower[0] < upper[0] && none == 0.0;
    const bool entered = !crosses || t0 > t_first;
    if (!crosses) t0 = t_first;
    // From here on the ray starts where it enters the box: far origins cost no digits within it.
    auto enter = [&](double at, double d, double low, double high) {
        return wp::min(wp::max(t0 == 0.0 ? at : at + t0 * d, low), high);
    };
    const double qx = enter(qx0, dx, lower[0], upper[0]), qy = enter(qy0, dy, lower[1], upper[1]),
                 qz = enter(qz0, dz, lower[2], upper[2]);
    const double out = wp::min(((fx ? upper[0] : lower[0]) - qx) * ix, wp::min(((fy ? upper[1] : lower[1]) - qy) * iy,
                                                                           ((fz ? upper[2] : lower[2]) - qz) * iz));
    const double last = wp::min(out, t_last - t0);
    const bool left = !crosses || out < t_last - t0;
    // On its upper side the box ends with a cell, not with the voxel behind it.
    int bx = (int)(crosses ? wp::min(wp::floor(qx), upper[0] - 1.0) : 0.0);
    int by = (int)(crosses ? wp::min(wp::floor(qy), upper[1] - 1.0) : 0.0);
    int bz = (int)(crosses ? wp::min(wp::floor(qz), upper[2] - 1.0) : 0.0);
"""
STEPS = """
    // The cell around a coordinate among those from `low` on; rounding must not put it anywhere else.
    auto within = [](double at, int low, int count) {
        const double above = at - (double)low;
        return low + (above < 0.0 ? 0 : above >= (double)count ? count - 1 : (int)above);
    };
    // Which border is next cannot be predicted: a selection is quicker than a branch.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
    auto pick = [](bool which, auto one, auto other) { return __builtin_unpredictable(which) ? one : other; };
#else
    auto pick = [](bool which, auto one, auto other) { return which ? one : other; };
#endif
"""
_WALK = (
    TREE
    + SET_UP
    + STEPS
    + """
    double ta = 0.0, tb = 0.0;
    int unseen = -1;
    START
    BLOCK_WALK
    while (crosses && ta <= last) {
        const int gi = (int)((unsigned)bx + (unsigned)anchor[0]), gj = (int)((unsigned)by + (unsigned)anchor[1]),
                  gk = (int)((unsigned)bz + (unsigned)anchor[2]);
        int size;
        address node = descend(gi, gj, gk, size);
        if (node == 0) node = leaf_or_tile((gi >> 3 & 15) << 8 | (gj >> 3 & 15) << 4 | (gk >> 3 & 15));
        const bool in_leaf = node & 1;
        real value = (real)0;
        // First cell, and number of cells along each edge, of what is crossed in this step.
        int lx = bx - ((int)((unsigned)bx + (unsigned)anchor[0]) & (size - 1)),
            ly = by - ((int)((unsigned)by + (unsigned)anchor[1]) & (size - 1)),
            lz = bz - ((int)((unsigned)bz + (unsigned)anchor[2]) & (size - 1));
        if (!in_leaf) {
            value = voxel(node, bx, by, bz);
            int cells = 8;
            if (size > 8 && bx - lx < size - 1 && by - ly < size - 1 && bz - lz < size - 1) {
                cells = size - 1;  // the last cells of a tile also see what is beside it
            } else {
                lx = bx - (bx & 7);
                ly = by - (by & 7);
                lz = bz - (bz & 7);
            }
            const double tx = ((double)lx + fx * cells - qx) * ix, ty = ((double)ly + fy * cells - qy) * iy,
                         tz = ((double)lz + fz * cells - qz) * iz;
            const bool along_x = tx <= ty && tx <= tz, along_y = !along_x && ty <= tz;
            const double ahead = wp::max(ta, along_x ? tx : along_y ? ty : tz);
            bool alike = true;
            if (cells == 8) {
                // Which neighbours the ray comes to see within this block.
                const double end = wp::min(ahead, last);
                const int seen = (qx + (fx ? end : ta) * dx > (double)(lx + 7) ? 1 : 0)
                               | (qy + (fy ? end : ta) * dy > (double)(ly + 7) ? 2 : 0)
                               | (qz + (fz ? end : ta) * dz > (double)(lz + 7) ? 4 : 0);
                for (int m = 1; m < 8 && alike; ++m) {
                    if (m & ~seen) continue;
                    const int x = lx + 8 * (m & 1), y = ly + 4 * (m & 2), z = lz + 2 * (m & 4);
                    const address beside = find(x, y, z, ignored);
                    alike = !(beside & 1);
                    if (alike) {
                        const real other = voxel(beside, x, y, z);
                        alike = SAME;
                    }
                }
            }
            if (alike) {
                tb = wp::min(ahead, last);
                unseen = -1;
                ON_REGION
                ta = ahead;
                bx = along_x ? (fx ? lx + cells : lx - 1) : within(qx + ta * dx, lx, cells);
                by = along_y ? (fy ? ly + cells : ly - 1) : within(qy + ta * dy, ly, cells);
                bz = !along_x && !along_y ? (fz ? lz + cells : lz - 1) : within(qz + ta * dz, lz, cells);
                continue;
            }
        }
        address beside[8] = {node, 0, 0, 0, 0, 0, 0, 0};
        double tx = ((double)(bx + fx) - qx) * ix, ty = ((double)(by + fy) - qy) * iy,
               tz = ((double)(bz + fz) - qz) * iz;
        for (;;) {
            const bool along_x = tx <= ty && tx <= tz, along_y = !along_x && ty <= tz;
            const double next = wp::max(ta, along_x ? tx : along_y ? ty : tz);
            tb = wp::min(next, last);
            const bool mixed = false;
            const int x = bx - lx, y = by - ly, z = bz - lz;
            real c[8];
            READ_INNER
            {
                for (int m = 0; m < 8; ++m) {
                    const int i = x + (m >> 2), j = y + (m >> 1 & 1), k = z + (m & 1);
                    const int block = i >> 3 << 2 | j >> 3 << 1 | k >> 3;
                    if (beside[block] == 0) beside[block] = find(lx + i, ly + j, lz + k, ignored);
                    c[m] = voxel(beside[block], lx + i, ly + j, lz + k);
                }
            }
            ON_CELL
            unseen = -1;
            ta = next;
            if (!(ta <= last)) break;
            if (along_x) {
                bx += sx;
                tx = ((double)(bx + fx) - qx) * ix;
            } else if (along_y) {
                by += sy;
                ty = ((double)(by + fy) - qy) * iy;
            } else {
                bz += sz;
                tz = ((double)(bz + fz) - qz) * iz;
            }
            if (((bx - lx) | (by - ly) | (bz - lz)) & ~7) break;
        }
    }
    END
"""
)

# The same by the blocks and cells that crossing_blocks_kernels found; where it found none the walk above goes on.
# CLEAR is `int clear` of the block that the ray is in, how many blocks ahead of it hold no crossing; CELLS goes through
# the cells of a block that may hold one.
BLOCK_WALK = """
    if (reach.shape[0] != 0) {
        // The distances ahead, for rays of this octant.
        const signed char* const ahead = (const signed char*)reach.data
            + (long long)(reach.shape[0] >> 3) * ((1 - fx) << 2 | (1 - fy) << 1 | (1 - fz));
        while (crosses) {
            auto here = [&]() {
                return (((bx >> 3) - first_block[0]) * block_count[1] + ((by >> 3) - first_block[1])) * block_count[2]
                     + ((bz >> 3) - first_block[2]);
            };
            CLEAR
            bool along_x = false, along_y = false;
            if (clear > 0) {
                do {
                    // No block fewer than this number of blocks ahead holds a crossing: leave the cube that they make.
                    const int span = 8 * clear, beyond = span - 8;
                    const int lx = (bx & ~7) - (fx ? 0 : beyond), ly = (by & ~7) - (fy ? 0 : beyond),
                              lz = (bz & ~7) - (fz ? 0 : beyond);
                    const double tx = ((double)(lx + fx * span) - qx) * ix, ty = ((double)(ly + fy * span) - qy) * iy,
                                 tz = ((double)(lz + fz * span) - qz) * iz;
                    along_x = (tx <= ty) & (tx <= tz);
                    along_y = !along_x & (ty <= tz);
                    const double t = pick(along_x, tx, pick(along_y, ty, tz));
                    ta = t > ta ? t : ta;
                    if (!(ta <= last)) break;
                    bx = along_x ? (fx ? lx + span : lx - 1) : within(qx + ta * dx, lx, span);
                    by = along_y ? (fy ? ly + span : ly - 1) : within(qy + ta * dy, ly, span);
                    bz = !(along_x | along_y) ? (fz ? lz + span : lz - 1) : within(qz + ta * dz, lz, span);
                    clear = ahead[here()];
                } while (clear > 0);
                unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
                ON_UNSEEN
            }
            if (clear < 0 || !(ta <= last)) break;
            const int number = numbers.data[here()];
            const address* block = (const address*)blocks.data + BLOCK_WORDS * (address)number;
            const address* nodes = block + 8;
            CELLS
        }
        crosses = false;
    }
"""

# The cell x, y, z of a block, with a crossing perhaps, from ta to the next border.
CELL = """
                    bx = lx + x;
                    by = ly + y;
                    bz = lz + z;
                    tb = next < last ? next : last;
                    const bool mixed = true;
                    const address node = nodes[0];
                    const bool in_leaf = node & 1;
                    real c[8];
                    READ_INNER
                    {
                        for (int m = 0; m < 8; ++m) {
                            const int i = x + (m >> 2), j = y + (m >> 1 & 1), k = z + (m & 1);
                            c[m] = voxel(nodes[i >> 3 << 2 | j >> 3 << 1 | k >> 3], lx + i, ly + j, lz + k);
                        }
                    }
                    ON_CELL
                    unseen = -1;
"""

# From cell to cell of a block; which border is next is a branch.
_CELLS = """
            const int lx = bx & ~7, ly = by & ~7, lz = bz & ~7;
            int x = bx - lx, y = by - ly, z = bz - lz;
            double tx = ((double)(bx + fx) - qx) * ix, ty = ((double)(by + fy) - qy) * iy,
                   tz = ((double)(bz + fz) - qz) * iz;
            do {
                along_x = tx <= ty && tx <= tz;
                along_y = !along_x && ty <= tz;
                const double t = along_x ? tx : along_y ? ty : tz;
                const double next = t > ta ? t : ta;
                if (block[x] >> (y << 3 | z) & 1) {
                    CELL
                } else {
                    unseen = along_x ? 4 * (1 - fx) : along_y ? 2 * (1 - fy) : 1 - fz;
                    ON_UNSEEN
                }
                ta = next;
                if (along_x) {
                    x += sx;
                    tx = ((double)(lx + x + fx) - qx) * ix;
                } else if (along_y) {
                    y += sy;
                    ty = ((double)(ly + y + fy) - qy) * iy;
                } else {
                    z += sz;
                    tz = ((double)(lz + z + fz) - qz) * iz;
                }
            } while (!((x | y | z) & ~7));
            if (!(ta <= last)) break;
            bx = lx + x;
            by = ly + y;
            bz = lz + z;
"""


def traversal(
    grid_type: str, *, start: str, same: str, on_region: str, on_cell: str, end: str, on_unseen: str | None = None
) -> str:
    """The text of a walk along a ray.

    Args:
        grid_type: "float", or "scalar" for every type of one component.
        start: What is done where the ray enters the box.
        same: Whether the blocks of ``value`` and ``other``, side by side, can be crossed in one step.
        on_region: What is done with a stretch of a constant value.
        on_cell: What is done with a cell.
        end: What is done where the box or the ray ends.
        on_unseen: What is done where the ray comes out of blocks that it crossed unseen; None where all are looked at.
    Returns:
        C++ text in which the ray's names are expected, see above.
    """
    blocks = "" if on_unseen is None else BLOCK_WALK
    hooks = {
        "BLOCK_WALK": blocks,
        "CELLS": _CELLS,
        "CELL": CELL,
        "CLEAR": "            int clear = ahead[here()];",
        "START": start,
        "ON_UNSEEN": on_unseen or "",
        "ON_REGION": on_region,
        "ON_CELL": on_cell,
        "END": end,
    }
    text = _WALK.replace("alike = SAME;", f"alike = {same};")
    return tree_text(with_hooks(text, hooks), grid_type)


def with_hooks(text: str, hooks: dict[str, str]) -> str:
    """The text with the lines that are a hook's name replaced by the hook, one after the other."""
    for name, hook in hooks.items():
        text = "\n".join(hook if line.strip() == name else line for line in text.split("\n"))
    return text
