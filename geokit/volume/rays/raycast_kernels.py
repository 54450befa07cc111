"""The first crossing of the trilinear interpolant with an isovalue along each ray.

In a cell the interpolant is a cubic along the ray. Between the roots of its derivative it is monotone, so that a change
of sign there brackets exactly one root, and without one there is none.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.rays.traverse_kernels import traversal, with_hooks

# Equal bits on every device; loops as they stand compile in a tenth of the time.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Of a thread on a GPU; see docs/design/layers.md.
REGISTERS = 96

# Directions shorter than this would lose digits as denormal numbers.
SHORTEST_DIRECTION = wp.constant(wp.float64(1e-150))
# Bisection alone needs 53 halvings to reach the last bit of a position in a cell; Newton's steps take about five.
MOST_ITERATIONS = 64
# Two units in the last place of a position in a cell.
RESOLUTION = 4.5e-16

# Coefficients p0 to p3 of the interpolant along the ray in a cell, by s = 0 at ta and 1 at tb; e and g are where the
# ray enters the cell and how far it moves in it.
CUBIC = """
    const double ex = (qx - (double)bx) + ta * dx, ey = (qy - (double)by) + ta * dy, ez = (qz - (double)bz) + ta * dz;
    const double gx = (tb - ta) * dx, gy = (tb - ta) * dy, gz = (tb - ta) * dz;
    const double low = (double)c[0], kx = (double)c[4] - low, ky = (double)c[2] - low, kz = (double)c[1] - low;
    const double kxy = ((double)c[6] - (double)c[2]) - kx, kxz = ((double)c[5] - (double)c[1]) - kx,
                 kyz = ((double)c[3] - (double)c[1]) - ky;
    const double kxyz = (((double)c[7] - (double)c[3]) - ((double)c[5] - (double)c[1])) - kxy;
    const double mx = kx + ey * kxy, my = ky + ez * kyz, mz = kz + ex * kxz;
    double p0 = (low + ex * mx + ey * my + ez * mz) + ex * ey * ez * kxyz;
    const double p1 = gx * (mx + ez * (kxz + ey * kxyz)) + gy * (my + ex * (kxy + ez * kxyz))
                    + gz * (mz + ey * (kyz + ex * kxyz));
    const double p2 = gx * gy * (kxy + ez * kxyz) + gx * gz * (kxz + ey * kxyz) + gy * gz * (kyz + ex * kxyz);
    const double p3 = gx * gy * gz * kxyz;
"""

START = """
    // 2 for NaN. Voxels are compared with the isovalue in their own type.
    auto side_of = [&](real v) { return v > (real)below ? 1 : v < (real)above ? -1 : v == v ? 0 : 2; };
    // The side of the isovalue on which the ray was last, 0 where that is not known. Two cells may differ by a rounding
    // about the face between them: what changes there counts, so that no crossing falls between cells.
    int side = 0;
    double hit = (double)INFINITY;
    double slope[3] = {0.0, 0.0, 0.0};
    if (!(t_first <= t_last)) goto done;
    if (entered) {
        side = side_of(background);
        if (side == 0) {
            hit = t_first;
            goto done;
        }
        if (side == 2) side = 0;
    }
"""
ON_UNSEEN = "                    side = 0;"
_SAME = "side_of(value) == side_of(other)"
_ON_REGION = """
            const int now = side_of(value);
            if (now == 0 || (now != 2 && now * side < 0)) {
                hit = t0 + ta;
                goto done;
            }
            side = now == 2 ? 0 : now;
"""
# HAND_ON may end the walk where the bracket of a root is known.
ON_CELL = (
    (
        """
            if (unseen >= 0) side = c[unseen] > (real)below ? 1 : -1;
            bool over = !mixed, under = !mixed;
            for (int m = 0; m < 8; ++m) {
                over = over & (c[m] > (real)below);
                under = under & (c[m] < (real)above);
            }
            const int now = over ? 1 : under ? -1 : 0;
            if (now == 0 || now * side < 0) {
"""
        + CUBIC
        + """
                p0 -= isovalue;
                auto at = [&](double s) { return ((p3 * s + p2) * s + p1) * s + p0; };
                double root = -1.0;
                const int first = p0 > 0.0 ? 1 : p0 < 0.0 ? -1 : 0;
                if (now != 0 || (p0 == 0.0 || first * side < 0)) {
                    root = 0.0;
                } else {
                    // Where the derivative (3 p3, 2 p2, p1) vanishes, by the formula that does not cancel.
                    double ends[3] = {1.0, 1.0, 1.0};
                    const double square = p2 * p2 - 3.0 * p3 * p1;
                    // Most cells are seen at once to be monotone along the ray.
                    if (square > 0.0 && 2.0 * wp::abs(p2) + 3.0 * wp::abs(p3) >= wp::abs(p1)) {
                        const double w = -(p2 + (p2 < 0.0 ? -wp::sqrt(square) : wp::sqrt(square)));
                        double one = w / (3.0 * p3), two = p1 / w;
                        if (!(one > 0.0 && one < 1.0)) one = 1.0;
                        if (!(two > 0.0 && two < 1.0)) two = 1.0;
                        ends[0] = wp::min(one, two);
                        ends[1] = wp::max(one, two);
                    }
                    double lo = 0.0, at_lo = p0;
                    for (int n = 0; n < 3 && root < 0.0 && lo < 1.0; ++n) {
                        double hi = ends[n];
                        const double at_hi = at(hi);
                        if (at_hi == 0.0) {
                            root = hi;
                        } else if ((at_hi > 0.0) != (at_lo > 0.0) && at_hi == at_hi) {
                            HAND_ON
                            // Newton, kept between the ends of the bracket.
                            double s = lo + (hi - lo) * (at_lo / (at_lo - at_hi)), left_end = lo, right_end = hi;
                            double moved = hi - lo;
                            for (int round = 0; round < ROUNDS; ++round) {
                                const double v = at(s);
                                if (v == 0.0) break;
                                if ((v > 0.0) == (at_lo > 0.0)) left_end = s;
                                else right_end = s;
                                const double rise = (3.0 * p3 * s + 2.0 * p2) * s + p1;
                                double better = s - v / rise;
                                // Beside multiple roots Newton's steps hardly shrink: halving is quicker there.
                                if (!(better >= left_end && better <= right_end && wp::abs(better - s) <= 0.5 * moved))
                                    better = 0.5 * (left_end + right_end);
                                moved = wp::abs(better - s);
                                s = better;
                                if (moved <= RESOLUTION) break;
                            }
                            root = s;
                        }
                        lo = hi;
                        at_lo = at_hi;
                    }
                    side = at_lo > 0.0 ? 1 : at_lo < 0.0 ? -1 : 0;
                }
                if (root >= 0.0) {
                    hit = t0 + (ta + root * (tb - ta));
                    const double ux = ex + root * gx, uy = ey + root * gy, uz = ez + root * gz;
                    slope[0] = (kx + uy * kxy) + uz * (kxz + uy * kxyz);
                    slope[1] = (ky + ux * kxy) + uz * (kyz + ux * kxyz);
                    slope[2] = (kz + ux * kxz) + uy * (kyz + ux * kxyz);
                    goto done;
                }
            } else {
                side = now;
            }
"""
    )
    .replace("ROUNDS", str(MOST_ITERATIONS))
    .replace("RESOLUTION", str(RESOLUTION))
)
END = """
    if (left) {
        const int now = side_of(background);
        if (now == 0 || (now != 2 && now * side < 0)) hit = t0 + last;
    }
done:
    return wp::vec_t<4, double>(hit, slope[0], slope[1], slope[2]);
"""


# Numbers whose squares double cannot hold would hide where the cubic turns: a cell of such is scaled by a power of two,
# which rounds nothing. Squares of float32 numbers are far from there.
_UNIT = """
                double unit = 1.0;
                {
                    double most = wp::abs(isovalue);
                    for (int m = 0; m < 8; ++m) most = wp::max(most, wp::abs((double)c[m]));
                    if (most > 1e140) unit = 0x1p-600;
                    else if (most < 1e-140) unit = 0x1p600;
                }
"""


def in_units(on_cell: str) -> str:
    """ON_CELL with the cell's voxels, and so the coefficients and slopes, in units that suit them."""
    scaled = CUBIC.replace("(double)c[", "unit * (double)c[")
    return on_cell.replace(CUBIC, _UNIT + scaled).replace("p0 -= isovalue;", "p0 -= unit * isovalue;")


def _first_crossing(grid_type: str) -> str:
    on_cell = with_hooks(ON_CELL, {"HAND_ON": ""})
    if grid_type != "float":
        on_cell = in_units(on_cell)
    return traversal(
        grid_type, start=START, same=_SAME, on_unseen=ON_UNSEEN, on_region=_ON_REGION, on_cell=on_cell, end=END
    )


@wp.func_native(_first_crossing("float"))
def float_crossing(
    volume: wp.uint64,
    anchor: wp.vec3i,
    lower: wp.vec3d,
    upper: wp.vec3d,
    reach: wp.array(dtype=wp.int8),
    numbers: wp.array(dtype=int),
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    blocks: wp.array(dtype=wp.uint64),
    start: wp.vec3d,
    toward: wp.vec3d,
    t_first: wp.float64,
    t_last: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
) -> wp.vec4d:
    """Where a ray first meets the isovalue, infinite where it does not, and the interpolant's slopes there by index.

    ``below`` and ``above`` are the isovalue, or the voxel type's numbers next to it where it is not one of them.
    """
    ...


@wp.func_native(_first_crossing("scalar"))
def scalar_crossing(
    volume: wp.uint64,
    anchor: wp.vec3i,
    lower: wp.vec3d,
    upper: wp.vec3d,
    reach: wp.array(dtype=wp.int8),
    numbers: wp.array(dtype=int),
    first_block: wp.vec3i,
    block_count: wp.vec3i,
    blocks: wp.array(dtype=wp.uint64),
    start: wp.vec3d,
    toward: wp.vec3d,
    t_first: wp.float64,
    t_last: wp.float64,
    isovalue: wp.float64,
    below: wp.float64,
    above: wp.float64,
) -> wp.vec4d: ...


@wp.struct
class RayField:
    """What rays need to know of a grid."""

    volume: wp.uint64
    # World to index, relative to the anchor voxel: to_index * (point - corner).
    corner: wp.vec3d
    to_index: wp.mat33d
    anchor: wp.vec3i
    # Outside of this box all is background, index space relative to the anchor.
    lower: wp.vec3d
    upper: wp.vec3d
    # What can be crossed unseen, see crossing_blocks_kernels; empty where that is not known.
    reach: wp.array(dtype=wp.int8)
    numbers: wp.array(dtype=int)
    first_block: wp.vec3i
    block_count: wp.vec3i
    blocks: wp.array(dtype=wp.uint64)


@wp.func
def is_usable(origin: wp.vec3d, direction: wp.vec3d) -> bool:
    """Whether a ray is finite and has a direction."""
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    none = (origin - origin) + (direction - direction)
    return largest >= SHORTEST_DIRECTION and none[0] + none[1] + none[2] == wp.float64(0.0)


@wp.func
def index_ray(field: RayField, origin: wp.vec3d, direction: wp.vec3d, t_min: wp.float64, max_distance: wp.float64):
    """Start and direction in index space, the latter's largest component 1; its first and last t; units of t."""
    largest = wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2]))
    unit = direction / largest
    toward = field.to_index * unit
    voxels = wp.max(wp.max(wp.abs(toward[0]), wp.abs(toward[1])), wp.abs(toward[2]))
    reach = max_distance / wp.length(unit) * voxels
    scale = voxels * largest
    return field.to_index * (origin - field.corner), toward / voxels, t_min * scale, reach, scale


@wp.func
def write_hit(
    i: int,
    found: wp.vec4d,
    scale: wp.float64,
    to_index: wp.mat33d,
    origin: wp.vec3d,
    direction: wp.vec3d,
    out_t: wp.array(dtype=wp.float64),
    out_points: wp.array(dtype=wp.vec3d),
    out_normals: wp.array(dtype=wp.vec3d),
):
    if found[0] == wp.float64(wp.INF):
        none = wp.float64(wp.NAN)
        out_t[i] = found[0]
        out_points[i] = wp.vec3d(none, none, none)
        out_normals[i] = wp.vec3d(none, none, none)
        return
    t = found[0] / scale
    out_t[i] = t
    out_points[i] = origin + direction * t
    slope = wp.vec3d(found[1], found[2], found[3])
    out_normals[i] = wp.normalize(wp.transpose(to_index) * slope)


@wp.kernel(cuda_max_registers=REGISTERS)
def raycast_float_kernel(
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
    i = first + wp.tid()
    origin = origins[i]
    direction = directions[i]
    if not is_usable(origin, direction):
        # The host refuses the whole batch and says which row is to blame.
        out_bad[0] = 1
        return
    start, toward, t_first, t_last, scale = index_ray(field, origin, direction, t_min, max_distance)
    found = float_crossing(
        field.volume,
        field.anchor,
        field.lower,
        field.upper,
        field.reach,
        field.numbers,
        field.first_block,
        field.block_count,
        field.blocks,
        start,
        toward,
        t_first,
        t_last,
        isovalue,
        below,
        above,
    )
    write_hit(i, found, scale, field.to_index, origin, direction, out_t, out_points, out_normals)


@wp.kernel(cuda_max_registers=REGISTERS)
def raycast_scalar_kernel(
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
    i = first + wp.tid()
    origin = origins[i]
    direction = directions[i]
    if not is_usable(origin, direction):
        out_bad[0] = 1
        return
    start, toward, t_first, t_last, scale = index_ray(field, origin, direction, t_min, max_distance)
    found = scalar_crossing(
        field.volume,
        field.anchor,
        field.lower,
        field.upper,
        field.reach,
        field.numbers,
        field.first_block,
        field.block_count,
        field.blocks,
        start,
        toward,
        t_first,
        t_last,
        isovalue,
        below,
        above,
    )
    write_hit(i, found, scale, field.to_index, origin, direction, out_t, out_points, out_normals)
