"""As _raycast_kernels, on a CPU and by blocks: a thread works on a few rays side by side.

What all rays do alike is vector arithmetic: their way into index space and into the box, the jumps to the first block
that may hold a crossing, the last steps to the root in a cell, and the world's point and normal. In between each ray
goes its own way. All operations are those of _raycast_kernels, so answers are equal to the last bit.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.cached_accessor_kernels import TREE, tree_text
from geokit.volume.rays.ray_packet_cpu_kernels import ARRAYS, BRACKET, GROUP, JUMPS, RAY, READ, ROOTS, WRITE, lines
from geokit.volume.rays.raycast_kernels import END, ON_CELL, ON_UNSEEN, START, RayField, in_units
from geokit.volume.rays.traverse_kernels import BLOCK_WALK, CELL, SET_UP, STEPS, with_hooks
from geokit.volume.sampling.trilinear_cell_kernels import MATRIX, ONE_BY_ONE

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Where a cubic's coefficients add up to less, no value or slope of it on [0, 1] overflows.
LARGEST_SUM = 1e300

# A function of its own: registers for the walk alone.
_WALK = """
    auto walk = [](const auto& field, const Rays& rays, Brackets& found, int q, double isovalue, double below,
                   double above) __attribute__((noinline)) -> wp::vec_t<4, double> {
        const unsigned long long volume = field.volume;
        const auto& anchor = field.anchor;
        const auto& reach = field.reach;
        const auto& numbers = field.numbers;
        const auto& blocks = field.blocks;
        const auto& first_block = field.first_block;
        const auto& block_count = field.block_count;
        TREE
        STEPS
        LOAD
        const int sx = fx ? 1 : -1, sy = fy ? 1 : -1, sz = fz ? 1 : -1;
        const double step_x = sx, step_y = sy, step_z = sz;
        double tb = 0.0;
        int known = clear_there;
        START
        if (unseen >= 0) {
            ON_UNSEEN
        }
        BLOCK_WALK
        END
    };
    double hit[G], sx[G], sy[G], sz[G];
    ONE_BY_ONE
    for (int q = 0; q < G; ++q) {
        hit[q] = sx[q] = sy[q] = sz[q] = 0.0;
        if (q >= count) continue;
        const auto met = walk(field, rays, found, q, isovalue, below, above);
        hit[q] = met[0]; sx[q] = met[1]; sy[q] = met[2]; sz[q] = met[3];
    }
"""
# From cell to cell of a block, without branches: the borders behind the next are known before one of them is chosen.
# Random rays are 8% quicker than with traverse_kernels' branches, those of a camera 3% slower.
_CELLS = """
            const int lx = bx & ~7, ly = by & ~7, lz = bz & ~7;
            // The next borders (t), and those behind them (a, u).
            double ax = (double)(bx + fx), ay = (double)(by + fy), az = (double)(bz + fz);
            double tx = (ax - qx) * ix, ty = (ay - qy) * iy, tz = (az - qz) * iz;
            ax += step_x; ay += step_y; az += step_z;
            double ux = (ax - qx) * ix, uy = (ay - qy) * iy, uz = (az - qz) * iz;
            // Coordinates in the block plus 8, ten bits for each.
            int cell = (bx - lx + 8) << 20 | (by - ly + 8) << 10 | (bz - lz + 8);
            do {
                along_x = (tx <= ty) & (tx <= tz);
                along_y = !along_x & (ty <= tz);
                const double t = pick(along_x, tx, pick(along_y, ty, tz));
                const double next = t > ta ? t : ta;
                if (block[cell >> 20 & 7] >> ((cell >> 7 & 56) | (cell & 7)) & 1) {
                    const int x = cell >> 20 & 7, y = cell >> 10 & 7, z = cell & 7;
                    CELL
                } else {
                    unseen = pick(along_x, 4 * (1 - fx), pick(along_y, 2 * (1 - fy), 1 - fz));
                    ON_UNSEEN
                }
                ta = next;
                const bool along_z = !(along_x | along_y);
                cell += pick(along_x, sx * (1 << 20), pick(along_y, sy * (1 << 10), sz));
                tx = pick(along_x, ux, tx); ty = pick(along_y, uy, ty); tz = pick(along_z, uz, tz);
                ax = pick(along_x, ax + step_x, ax); ay = pick(along_y, ay + step_y, ay);
                az = pick(along_z, az + step_z, az);
                ux = (ax - qx) * ix; uy = (ay - qy) * iy; uz = (az - qz) * iz;
            } while (!((cell ^ 0x802008) & ~0x701c07));
            if (!(ta <= last)) break;
            bx = lx + (cell >> 20) - 8;
            by = ly + (cell >> 10 & 31) - 8;
            bz = lz + (cell & 31) - 8;
"""
_CLEAR = """
            int clear = known;
            known = 1;
            if (clear > 0) clear = ahead[here()];
"""
_HAND_ON = f"""
                            if (wp::abs(p0) + wp::abs(p1) + wp::abs(p2) + wp::abs(p3) < {LARGEST_SUM!r}) {{
                                const int n = found.count++;
                                found.row[n] = q;
                                {lines("found.NAME[n] = NAME;", BRACKET)}
                                return wp::vec_t<4, double>();
                            }}
"""


def _load():
    constant = [name for name in RAY["double"] if name not in ("ta", "scale")]
    text = lines("const double NAME = rays.NAME[q];", constant) + "        double ta = rays.ta[q];\n"
    text += lines("const int NAME = rays.NAME[q];", "fx fy fz entered left".split())
    text += lines("int NAME = rays.NAME[q];", "bx by bz crosses unseen".split())
    return text + "        const int clear_there = rays.clear[q];\n"


def _group(grid_type):
    """C++ for up to GROUP rays from ``start`` on; returns 1, and writes nothing, where one of them is not usable."""
    hooks = {
        "TREE": TREE,
        "STEPS": STEPS,
        "SET_UP": SET_UP,
        "MATRIX": MATRIX,
        "LOAD": _load(),
        "KEEP": lines("rays.NAME[q] = NAME;", RAY["double"] + RAY["int"]),
        "REPEAT": lines("found.NAME[n] = found.NAME[0];", BRACKET),
        "START": START,
        "BLOCK_WALK": BLOCK_WALK,
        "CELLS": _CELLS,
        "CELL": CELL,
        "CLEAR": _CLEAR,
        "END": END,
        "ON_UNSEEN": ON_UNSEEN,
        "ON_CELL": ON_CELL if grid_type == "float" else in_units(ON_CELL),
        "HAND_ON": _HAND_ON,
        "ONE_BY_ONE": ONE_BY_ONE,
    }
    text = with_hooks(ARRAYS + READ + JUMPS + _WALK + ROOTS + WRITE, hooks)
    return f"#if !defined(__CUDA_ARCH__)\n{tree_text(text, grid_type)}\n#else\n    return 0;\n#endif\n"


@wp.func_native(_group("float"))
def float_crossings(
    start: int,
    stop: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
) -> int: ...


@wp.func_native(_group("scalar"))
def scalar_crossings(
    start: int,
    stop: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
) -> int: ...


# An item is a group of rays.
@wp.kernel
def raycast_float_groups_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, origins.shape[0])
    bad = float_crossings(
        start,
        stop,
        origins,
        directions,
        field,
        t_min,
        max_distance,
        isovalue,
        below,
        above,
        out_t,
        out_points,
        out_normals,
    )
    if bad != 0:
        # The host refuses the whole batch and says which row is to blame.
        out_bad[0] = 1


@wp.kernel
def raycast_scalar_groups_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
    out_bad: wp.array(dtype=int),
):
    start = (first + wp.tid()) * GROUP
    stop = wp.min(start + GROUP, origins.shape[0])
    bad = scalar_crossings(
        start,
        stop,
        origins,
        directions,
        field,
        t_min,
        max_distance,
        isovalue,
        below,
        above,
        out_t,
        out_points,
        out_normals,
    )
    if bad != 0:
        out_bad[0] = 1
