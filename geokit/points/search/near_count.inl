// Number of the sorted points `begin` to `end` - 1 within the radius of a query.
//
// Expects near_distance.inl, grid, begin, end, near. Returns the number.

int inside = 0, outside = 0;
#pragma unroll 4
for (int j = begin; j < end; ++j) {
    const float d = squared(j);
    inside += d <= near.surely;
    outside += d > near.possibly;
}
if (inside + outside != end - begin) {
    inside = 0;
    for (int j = begin; j < end; ++j) inside += decides(j);
}
return inside;
