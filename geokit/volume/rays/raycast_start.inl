// The state of a search for a crossing, where a ray enters the box.
//
// Expects the names of cached_accessor.inl and ray_box.inl; below and above, the isovalue, or the numbers of the
// voxel type next to it. Defines side_of, side, hit and slope. May end the walk by a goto to `done`.
    // 2 for NaN. Voxels are compared with the isovalue in their own type.
    auto side_of = [&](real v) { return v > (real)below ? 1 : v < (real)above ? -1 : v == v ? 0 : 2; };
    // The side of the isovalue on which the ray was last, 0 where that is not known. Two cells may differ by a
    // rounding about the face between them: what changes there counts, so that no crossing falls between cells.
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
