// The end of a search for a crossing, at the end of the box or of the ray, and the label `done`. Returns the ray
// parameter of the crossing, infinite for none, and the gradient there.
//
// Expects the names of raycast_start.inl.
if (left) {
    const int now = side_of(background);
    if (now == 0 || (now != 2 && now * side < 0)) hit = t0 + last;
}
done : return wp::vec_t<4, double>(hit, slope[0], slope[1], slope[2]);
