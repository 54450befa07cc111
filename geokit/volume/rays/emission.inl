// Optical depth along a ray, which is `scale` times the integral of the density, and the integral of the emission that
// reaches the ray's start.
//
// Expects field, a RayField of the density around both grids; emission_volume, a grid with the same transform; scale;
// the names of ray_box.inl; the constants OPAQUE, STEP_DEPTH and SHORTEST_STEP. Hooks:
// - IS_DARK: whether a stretch with the emission e0 to e3 needs no quadrature.
// - ON_LIGHT, ON_STRETCH, ON_LIGHT_CELL, ON_END: files of the derivatives (emission_slopes_start.inl), at each Gauss
//   point, behind each stretch, in each cell of the emission where the density is constant, and behind the walk.
// Without these, returns both as a wp::vec_t of two doubles.
#include "volume/rays/ray_field.inl"
{
    const unsigned long long volume = emission_volume;
#include "volume/nanovdb/cached_accessor.inl"
    (void)background;
    // Names of the emission's grid get the suffix _e, because the density's grid reuses the plain names below.
    typedef real real_e;
    typedef address address_e;
    auto& find_e = find;
    auto& voxel_e = voxel;
    const pnanovdb_grid_type_t grid_type_e = grid_type;
    (void)grid_type_e;
    {
        const unsigned long long volume = field.volume;
#include "volume/nanovdb/cached_accessor.inl"
#include "volume/rays/ray_box.inl"
#include "volume/rays/ray_steps.inl"
        double ta = 0.0, tb = 0.0;
        int unseen = -1, ignored_e;
        double depth = 0.0, light = 0.0;
        // Adds a stretch of the ray: emission e0 to e3 and density p0 to p3 are cubics of s, which is 0 and 1 at its ends.
        auto add = [&](double span, double p0, double p1, double p2, double p3, double e0, double e1, double e2,
                       double e3) {
            const double to_depth = scale * span;
            auto depth_at = [&](double s) {
                return to_depth * s * (p0 + s * (p1 / 2.0 + s * (p2 / 3.0 + s * p3 / 4.0)));
            };
            const double all = depth_at(1.0);
            const double node[6] = {0.03376524289842403, 0.16939530676686776, 0.38069040695840156,
                                    0.6193095930415985,  0.8306046932331322,  0.9662347571015759};
            const double weight[6] = {0.08566224618958514, 0.18038078652406936, 0.23395696728634552,
                                      0.23395696728634552, 0.18038078652406936, 0.08566224618958514};
            double from = 0.0, step = 1.0, before = 0.0;
            bool dark = IS_DARK;
            while (!dark && from < 1.0 && depth + before < OPAQUE) {
                step = wp::min(step, 1.0 - from);
                double after = depth_at(from + step);
                while (wp::abs(after - before) > STEP_DEPTH && step > SHORTEST_STEP) {
                    step *= 0.5;
                    after = depth_at(from + step);
                }
                for (int g = 0; g < 6; ++g) {
                    const double s = from + step * node[g], through = wp::exp(-(depth + depth_at(s)));
                    light += span * step * weight[g] * (e0 + s * (e1 + s * (e2 + s * e3))) * through;
#ifdef ON_LIGHT
#include ON_LIGHT
#endif
                }
                from += step;
                step *= 2.0;
                before = after;
                // With a depth of NaN the loop would never end.
                dark = !(after == after);
            }
            depth += all;
#ifdef ON_STRETCH
#include ON_STRETCH
#endif
        };
        // Crosses a region of constant density.
        auto cross_region = [&](double even) {
            const double end = tb, began = ta;
            const int kept_x = bx, kept_y = by, kept_z = bz;
            while (ta <= end) {
                int size_e;
                const address_e node_e = find_e(bx, by, bz, size_e);
                int ex0 = bx - ((int)((unsigned)bx + (unsigned)anchor[0]) & (size_e - 1)),
                    ey0 = by - ((int)((unsigned)by + (unsigned)anchor[1]) & (size_e - 1)),
                    ez0 = bz - ((int)((unsigned)bz + (unsigned)anchor[2]) & (size_e - 1));
                int cells_e = size_e - 1;
                const bool is_even = !(node_e & 1) && bx - ex0 < cells_e && by - ey0 < cells_e && bz - ez0 < cells_e;
                if (!is_even) {
                    ex0 = bx;
                    ey0 = by;
                    ez0 = bz;
                    cells_e = 1;
                }
                const double ux = ((double)ex0 + fx * cells_e - qx) * ix, uy = ((double)ey0 + fy * cells_e - qy) * iy,
                             uz = ((double)ez0 + fz * cells_e - qz) * iz;
                const bool by_x = ux <= uy && ux <= uz, by_y = !by_x && uy <= uz;
                const double leave = wp::max(ta, by_x ? ux : by_y ? uy : uz);
                tb = wp::min(leave, end);
                if (is_even) {
                    add(tb - ta, even, 0.0, 0.0, 0.0, (double)voxel_e(node_e, bx, by, bz), 0.0, 0.0, 0.0);
                } else {
#include "volume/rays/emission_voxels.inl"
                    add(tb - ta, even, 0.0, 0.0, 0.0, p0, p1, p2, p3);
#ifdef ON_LIGHT_CELL
#include ON_LIGHT_CELL
#endif
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
        };
#define SAME value == other
#define ON_REGION cross_region((double)value);
#include "volume/rays/traverse.inl"
#undef SAME
#undef ON_REGION
#ifdef ON_END
#include ON_END
#else
        return wp::vec_t<2, double>(depth, light);
#endif
    }
}
