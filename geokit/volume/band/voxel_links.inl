// Links of a plane of 64 voxels to the next ones along z, along y and in the next plane. The bit of a link is set if
// the distances of both voxels add up to more than their spacing, so that the surface cannot lie between them.
//
// Expects core/simd.inl; leaf, x, rows, distance, spacing, out_links.
const float* d = distance.data + 512ll * rows.data[leaf] + 64 * x;
unsigned long long z = 0, y = 0, next = 0;
#if defined(__CUDA_ARCH__)
for (int b = 0; b < 64; ++b) {
    const float here = d[b];
    if ((b & 7) < 7 && here + d[b + 1] > spacing) z |= 1ull << b;
    if (b < 56 && here + d[b + 8] > spacing) y |= 1ull << b;
    if (x < 7 && here + d[b + 64] > spacing) next |= 1ull << b;
}
#else
for (int r = 0; r < 8; ++r) {
    const v8 here = *(const v8*)(d + 8 * r);
    const v8 shifted = __builtin_shufflevector(here, here, 1, 2, 3, 4, 5, 6, 7, 7);
    z |= ((unsigned long long)mask_of(here + shifted > spacing) & 0x7f) << 8 * r;
    if (r < 7) y |= (unsigned long long)mask_of(here + *(const v8*)(d + 8 * r + 8) > spacing) << 8 * r;
    if (x < 7) next |= (unsigned long long)mask_of(here + *(const v8*)(d + 8 * r + 64) > spacing) << 8 * r;
}
#endif
unsigned long long* out = (unsigned long long*)out_links.data + 24ll * leaf + 3 * x;
out[0] = z;
out[1] = y;
out[2] = next;
