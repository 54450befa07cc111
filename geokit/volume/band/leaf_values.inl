// Writes the values and the mask of a plane into a leaf of a grid of floats.
//
// Expects plane_values.inl; begin, out_buffer.
unsigned char* out = out_buffer.data + begin + 2144ll * leaf;
unsigned long long active = 0;
for (int b = 0; b < 64; ++b) active |= (unsigned long long)(values[b] < exterior && values[b] > interior) << b;
for (int b = 0; b < 64; ++b) ((float*)(out + 96))[64 * x + b] = values[b];
((unsigned long long*)(out + 16))[x] = active;
