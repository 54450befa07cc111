"""Optical depth and emission along rays: integrals of the trilinear interpolant, cell by cell.

Along a ray the interpolant of a cell is a cubic, whose integral is a polynomial too.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

from geokit.volume.nanovdb.cached_accessor_kernels import TREE, tree_text
from geokit.volume.rays.raycast_kernels import CUBIC, RayField, index_ray, is_usable
from geokit.volume.rays.traverse_kernels import traversal

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# Optical depth of a step of the emission's quadrature, at most. Six Gauss points are then off by 1e-12 of a cubic times
# e^-x where x is a quartic; four were off by 1e-7 in rough fields.
STEP_DEPTH = 0.5
# The shortest step, as a share of a cell: where one is so dense that this is too long, nothing comes out of it anyway.
SHORTEST_STEP = 1e-12
# e^-x is zero in float64 beyond this.
OPAQUE = 746.0

_START = """
    double depth = 0.0;
"""
_ON_REGION = """
            depth += (double)value * (tb - ta);
"""
_ON_CELL = (
    CUBIC
    + """
            depth += (tb - ta) * (p0 + p1 / 2.0 + p2 / 3.0 + p3 / 4.0);
"""
)
_END = """
    return depth;
"""


def _depth(grid_type: str) -> str:
    return traversal(grid_type, start=_START, same="value == other", on_region=_ON_REGION, on_cell=_ON_CELL, end=_END)


# The names of the density's tree are taken: those of the emission get another ending.
_NAMES = (
    "volume buf grid grid_type root word upper_node lower_node in_upper in_lower descend leaf_or_tile find voxel "
    "ignored background address real"
).split()


def _emission_tree() -> str:
    text = tree_text(TREE, "scalar").replace("id_to_buffer(volume)", "id_to_buffer(emission_volume)")
    words = [""]
    for letter in text:
        if (letter.isalnum() or letter == "_") == (words[-1][-1:].isalnum() or words[-1][-1:] == "_"):
            words[-1] += letter
        else:
            words.append(letter)
    # Members of something keep their names.
    member = [before.endswith((".", ":")) for before in ["", *words]]
    return "".join(f"{word}_e" if word in _NAMES and not own else word for word, own in zip(words, member))


_EMISSION_START = (
    _emission_tree()
    + f"""
    (void)background_e;
    double depth = 0.0, light = 0.0;
    // Emission e0 to e3 and density p0 to p3 as cubics of s, which is 0 and 1 at the ends of a stretch.
    auto add = [&](double span, double p0, double p1, double p2, double p3, double e0, double e1, double e2,
                   double e3) {{
        const double to_depth = scale * span;
        auto depth_at = [&](double s) {{
            return to_depth * s * (p0 + s * (p1 / 2.0 + s * (p2 / 3.0 + s * p3 / 4.0)));
        }};
        const double all = depth_at(1.0);
        const double node[6] = {{0.03376524289842403, 0.16939530676686776, 0.38069040695840156,
                                 0.6193095930415985, 0.8306046932331322, 0.9662347571015759}};
        const double weight[6] = {{0.08566224618958514, 0.18038078652406936, 0.23395696728634552,
                                   0.23395696728634552, 0.18038078652406936, 0.08566224618958514}};
        double from = 0.0, step = 1.0, before = 0.0;
        bool dark = e0 == 0.0 && e1 == 0.0 && e2 == 0.0 && e3 == 0.0;
        while (!dark && from < 1.0 && depth + before < {OPAQUE}) {{
            step = wp::min(step, 1.0 - from);
            double after = depth_at(from + step);
            while (wp::abs(after - before) > {STEP_DEPTH} && step > {SHORTEST_STEP}) {{
                step *= 0.5;
                after = depth_at(from + step);
            }}
            for (int g = 0; g < 6; ++g) {{
                const double s = from + step * node[g];
                light += span * step * weight[g] * (e0 + s * (e1 + s * (e2 + s * e3)))
                       * wp::exp(-(depth + depth_at(s)));
            }}
            from += step;
            step *= 2.0;
            before = after;
            // A depth that is no number would never end.
            dark = !(after == after);
        }}
        depth += all;
    }};
"""
)
# What the emission is in the cell (bx, by, bz) of the density, and along the way through a region where that is even.
_EMISSION_CELL = """
                real_e c[8];
                for (int m = 0; m < 8; ++m) {
                    const int i = bx + (m >> 2), j = by + (m >> 1 & 1), k = bz + (m & 1);
                    c[m] = voxel_e(find_e(i, j, k, ignored_e), i, j, k);
                }
"""
_ON_EMISSION_CELL = (
    CUBIC
    + """
            {
                const double d0 = p0, d1 = p1, d2 = p2, d3 = p3;
"""
    + _EMISSION_CELL
    + CUBIC
    + """
                add(tb - ta, d0, d1, d2, d3, p0, p1, p2, p3);
            }
"""
)
_ON_EMISSION_REGION = (
    """
            {
                const double even = (double)value, end = tb, began = ta;
                const int kept_x = bx, kept_y = by, kept_z = bz;
                while (ta <= end) {
                    int size_e;
                    const address_e node_e = find_e(bx, by, bz, size_e);
                    int ex0 = bx - ((int)((unsigned)bx + (unsigned)anchor[0]) & (size_e - 1)),
                        ey0 = by - ((int)((unsigned)by + (unsigned)anchor[1]) & (size_e - 1)),
                        ez0 = bz - ((int)((unsigned)bz + (unsigned)anchor[2]) & (size_e - 1));
                    int cells_e = size_e - 1;
                    const bool is_even = !(node_e & 1) && bx - ex0 < cells_e && by - ey0 < cells_e
                                      && bz - ez0 < cells_e;
                    if (!is_even) {
                        ex0 = bx;
                        ey0 = by;
                        ez0 = bz;
                        cells_e = 1;
                    }
                    const double ux = ((double)ex0 + fx * cells_e - qx) * ix,
                                 uy = ((double)ey0 + fy * cells_e - qy) * iy,
                                 uz = ((double)ez0 + fz * cells_e - qz) * iz;
                    const bool by_x = ux <= uy && ux <= uz, by_y = !by_x && uy <= uz;
                    const double leave = wp::max(ta, by_x ? ux : by_y ? uy : uz);
                    tb = wp::min(leave, end);
                    if (is_even) {
                        add(tb - ta, even, 0.0, 0.0, 0.0, (double)voxel_e(node_e, bx, by, bz), 0.0, 0.0, 0.0);
                    } else {
"""
    + _EMISSION_CELL
    + CUBIC
    + """
                        add(tb - ta, even, 0.0, 0.0, 0.0, p0, p1, p2, p3);
                    }
                    ta = leave;
                    if (!(ta <= end)) break;
                    bx = by_x ? (fx ? ex0 + cells_e : ex0 - 1) : within(qx + ta * dx, ex0, cells_e);
                    by = by_y ? (fy ? ey0 + cells_e : ey0 - 1) : within(qy + ta * dy, ey0, cells_e);
                    bz = !(by_x || by_y) ? (fz ? ez0 + cells_e : ez0 - 1) : within(qz + ta * dz, ez0, cells_e);
                }
                ta = began;
                tb = end;
                bx = kept_x;
                by = kept_y;
                bz = kept_z;
            }
"""
)
_EMISSION_END = """
    return wp::vec_t<2, double>(depth, light);
"""


@wp.func_native(_depth("float"))
def float_depth(
    volume: wp.uint64,
    anchor: wp.vec3i,
    lower: wp.vec3d,
    upper: wp.vec3d,
    start: wp.vec3d,
    toward: wp.vec3d,
    t_first: wp.float64,
    t_last: wp.float64,
) -> wp.float64:
    """Integral of the values along a ray, its length counted in units of ``toward``."""
    ...


@wp.func_native(_depth("scalar"))
def scalar_depth(
    volume: wp.uint64,
    anchor: wp.vec3i,
    lower: wp.vec3d,
    upper: wp.vec3d,
    start: wp.vec3d,
    toward: wp.vec3d,
    t_first: wp.float64,
    t_last: wp.float64,
) -> wp.float64: ...


@wp.func_native(
    traversal(
        "scalar",
        start=_EMISSION_START,
        same="value == other",
        on_region=_ON_EMISSION_REGION,
        on_cell=_ON_EMISSION_CELL,
        end=_EMISSION_END,
    )
)
def scalar_emission(
    volume: wp.uint64,
    emission_volume: wp.uint64,
    scale: wp.float64,
    anchor: wp.vec3i,
    lower: wp.vec3d,
    upper: wp.vec3d,
    start: wp.vec3d,
    toward: wp.vec3d,
    t_first: wp.float64,
    t_last: wp.float64,
) -> wp.vec2d:
    """Optical depth, ``scale`` times the integral of the values; and the integral of the emission that is left."""
    ...


@wp.kernel
def depth_float_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_transmittance: wp.array(dtype=wp.float64),
    out_emission: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    if not is_usable(origins[i], directions[i]):
        # The host refuses the whole batch and says which row is to blame.
        out_bad[0] = 1
        return
    start, toward, t_first, t_last, scale = index_ray(field, origins[i], directions[i], t_min, max_distance)
    depth = float_depth(field.volume, field.anchor, field.lower, field.upper, start, toward, t_first, t_last)
    out_transmittance[i] = wp.exp(-extinction * depth * (wp.length(directions[i]) / scale))
    out_emission[i] = wp.float64(0.0)


@wp.kernel
def depth_scalar_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_transmittance: wp.array(dtype=wp.float64),
    out_emission: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    if not is_usable(origins[i], directions[i]):
        out_bad[0] = 1
        return
    start, toward, t_first, t_last, scale = index_ray(field, origins[i], directions[i], t_min, max_distance)
    depth = scalar_depth(field.volume, field.anchor, field.lower, field.upper, start, toward, t_first, t_last)
    out_transmittance[i] = wp.exp(-extinction * depth * (wp.length(directions[i]) / scale))
    out_emission[i] = wp.float64(0.0)


@wp.kernel
def emission_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    field: RayField,
    emission_volume: wp.uint64,
    t_min: wp.float64,
    max_distance: wp.float64,
    extinction: wp.float64,
    out_transmittance: wp.array(dtype=wp.float64),
    out_emission: wp.array(dtype=wp.float64),
    out_bad: wp.array(dtype=int),
):
    i = first + wp.tid()
    if not is_usable(origins[i], directions[i]):
        out_bad[0] = 1
        return
    start, toward, t_first, t_last, scale = index_ray(field, origins[i], directions[i], t_min, max_distance)
    unit = wp.length(directions[i]) / scale
    found = scalar_emission(
        field.volume,
        emission_volume,
        extinction * unit,
        field.anchor,
        field.lower,
        field.upper,
        start,
        toward,
        t_first,
        t_last,
    )
    out_transmittance[i] = wp.exp(-found[0])
    out_emission[i] = found[1] * unit
