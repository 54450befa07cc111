// Writes the eight planes of a leaf: bit masks of the voxels below the limit.
//
// Expects cells, leaf, limit; on a CPU also core/simd.inl.

const float* value = (const float*)(cells.values + cells.stride * (unsigned long long)leaf);
unsigned long long* out = cells.sides.data + 8ll * leaf;
#if defined(__CUDA_ARCH__)
for (int x = 0; x < 8; ++x) {
    unsigned long long word = 0;
    for (int n = 0; n < 64; ++n) word |= (unsigned long long)(value[64 * x + n] < limit) << n;
    out[x] = word;
}
#else
unsigned short* part = (unsigned short*)out;
for (int n = 0; n < 32; ++n) {
    part[n] = __builtin_bit_cast(unsigned short, __builtin_convertvector(((const v16*)value)[n] < limit, b16));
}
#endif
