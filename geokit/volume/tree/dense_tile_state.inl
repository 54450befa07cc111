// Returns the state of a tile: BAD if float32 cannot hold a value, LEAF if it has an active voxel or both signs, INSIDE
// if all its voxels are negative, else OUTSIDE.
//
// Expects dense_row.inl; x, y, z (its first voxel in the array); OUTSIDE, LEAF, INSIDE, BAD.
#if !defined(__CUDA_ARCH__)
unsigned active = 0, some = 0, all = 255, good = 255;
for (int n = 0; n < 64; ++n) {
    const v8 values = row_of(x + (n >> 3), y + (n & 7), z);
    const unsigned negative = mask_of(values < 0.f);
    active |= mask_of(is_active(values));
    some |= negative;
    all &= negative;
    // No comparison with NaN holds.
    good &= mask_of(magnitude(values) <= 3.402823466e38f);
}
if (good != 255) return BAD;
if (active) return LEAF;
if (!level_set || !some) return OUTSIDE;
// A block with both signs cannot be a tile, so it is a leaf without active voxels.
return all == 255 ? INSIDE : LEAF;
#else
return OUTSIDE;
#endif
