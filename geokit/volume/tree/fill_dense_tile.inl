// Writes the values of a tile and the mask of its active voxels; inactive voxels take the background's value, in a level
// set with their own sign.
//
// Expects dense_row.inl; x, y, z (its first voxel in the array), row (of the results), out_values, out_masks.
#if !defined(__CUDA_ARCH__)
v8* to = (v8*)((char*)out_values.data + row * (size_t)out_values.strides[0]);
unsigned char* mask = out_masks.data + row * (size_t)out_masks.strides[0];
for (int n = 0; n < 64; ++n) {
    const v8 values = row_of(x + (n >> 3), y + (n & 7), z);
    const i8 active = __builtin_convertvector(is_active(values), i8), inside = (values < 0.f) & (level_set ? -1 : 0);
    to[n] = active ? values : inside ? (v8)-background : (v8)background;
    mask[n] = (unsigned char)mask_of(active);
}
#endif
