// Bit masks of a plane's active voxels and of those with a negative value.
//
// Expects plane_values.inl; out_active, out_negative.
unsigned long long active = 0, negative = 0;
for (int b = 0; b < 64; ++b) {
    active |= (unsigned long long)(values[b] < exterior && values[b] > interior) << b;
    negative |= (unsigned long long)(values[b] < 0.f) << b;
}
((unsigned long long*)out_active.data)[8ll * leaf + x] = active;
((unsigned long long*)out_negative.data)[8ll * leaf + x] = negative;
