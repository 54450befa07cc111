// Bit mask of the sorted points from `begin` on, 64 at most and below `end`, that are within the radius of a query.
//
// Expects near_distance.inl, grid, begin, end, near. Returns the mask.

uint64_t inside = 0, doubt = 0;
const int count = end - begin < 64 ? end - begin : 64;
for (int k = 0; k < count; ++k) {
    const float d = squared(begin + k);
    inside |= uint64_t(d <= near.surely) << k;
    doubt |= uint64_t(!(d <= near.surely || d > near.possibly)) << k;
}
for (int k = 0; doubt; ++k, doubt >>= 1)
    if (doubt & 1) inside |= uint64_t(decides(begin + k)) << k;
return inside;
