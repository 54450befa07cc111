// Counts in a row of up to eight voxels: active ones, negative ones from bit 8, those that are no float32 from bit 16.
//
// Expects dense, i, j, k, count, background, tolerance, level_set; TYPE is that of the array's numbers. Returns the
// counts.
//
// In C++, where the compiler vectorizes it. The row is contiguous in memory.

const TYPE* row =
    (const TYPE*)((const char*)dense.data + i * (size_t)dense.strides[0] + j * (size_t)dense.strides[1]) + k;
int active = 0, negative = 0, bad = 0;
for (int n = 0; n < count; ++n) {
    const float value = (float)row[n];
    const float level = level_set ? ::fabsf(value) : value;
    active += ::fabs((double)level - (double)background) > tolerance;
    negative += value < 0.0f;
    // No comparison with NaN holds.
    bad += !(::fabsf(value) <= 3.402823466e38f);
}
return active | negative << 8 | bad << 16;
