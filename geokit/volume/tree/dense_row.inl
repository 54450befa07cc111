// Rows of eight voxels of a dense array.
//
// Expects core/simd.inl; dense, background, tolerance, level_set; TYPE is that of the array's numbers, ROW a vector of
// eight of them. Defines, on a CPU: row_of(i, j, z), float32 values from voxel z on, the background outside the array;
// is_active(values), a lane for each that differs from the background by more than the tolerance, in a level set from
// both its signs; magnitude(values).
#if !defined(__CUDA_ARCH__)
auto magnitude = [](const v8& values) -> v8 { return __builtin_elementwise_abs(values); };
auto row_of = [&](int i, int j, int z) {
    v8 values = background;
    if (i < 0 || j < 0 || i >= dense.shape[0] || j >= dense.shape[1]) return values;
    const TYPE* row =
        (const TYPE*)((const char*)dense.data + i * (size_t)dense.strides[0] + j * (size_t)dense.strides[1]);
    if (z >= 0 && z + 8 <= dense.shape[2]) return __builtin_convertvector(*(const ROW*)(row + z), v8);
    for (int k = z < 0 ? -z : 0; k < 8 && z + k < dense.shape[2]; ++k) values[k] = (float)row[z + k];
    return values;
};
auto is_active = [&](const v8& values) {
    const d8 level = __builtin_convertvector(level_set ? magnitude(values) : values, d8);
    return __builtin_elementwise_abs(level - (double)background) > tolerance;
};
#endif
