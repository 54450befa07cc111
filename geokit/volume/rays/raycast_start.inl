// The state of a search for a crossing at the ray's entry into the box.
//
// Expects the names of cached_accessor.inl and ray_box.inl; below and above, the isovalue or its neighbors in the
// voxel type. Defines side_of, side, hit and slope. May end the walk by a goto to `done`.
// 2 for NaN. Voxels are compared with the isovalue in their own type.
auto side_of = [&](real v) { return v > (real)below ? 1 : v < (real)above ? -1 : v == v ? 0 : 2; };
// The side of the isovalue on which the ray was last, 0 if unknown. Two cells may round differently on the face
// between them. A change of side there counts as a crossing, so that none is lost between cells.
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
