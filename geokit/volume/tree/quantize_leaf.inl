// A float leaf as codes of `bits` bits, bit for bit as NanoVDB writes them, and their largest error.
//
// Expects source, start, bits, rounding. Defines codes, low, quantum, and worst: the error, -1 if a value is not
// finite.
//
// In C++, because warp has no local arrays of this size. Minima and maxima run in eight lanes, which the compiler does
// not make of one.

const float* values = (const float*)(source.data + start + 96);
const unsigned units = (1u << bits) - 1u;
float lows[8], highs[8], nothing[8];
for (int k = 0; k < 8; ++k) {
    lows[k] = highs[k] = values[k];
    nothing[k] = 0.0f;
}
for (int n = 0; n < 512; n += 8) {
    for (int k = 0; k < 8; ++k) {
        const float value = values[n + k];
        nothing[k] += 0.0f * value;
        lows[k] = value < lows[k] ? value : lows[k];
        highs[k] = value > highs[k] ? value : highs[k];
    }
}
float low = lows[0], high = highs[0];
for (int k = 1; k < 8; ++k) {
    low = lows[k] < low ? lows[k] : low;
    high = highs[k] > high ? highs[k] : high;
}
const float span = high - low, quantum = span / (float)units;
unsigned short codes[512];
const float scale = (float)units / span;
// Sixteen bits need more than float32's 24 for the product; spans below 1e-36 have no float32 scale.
if (bits == 16 || !(scale <= 3.402823466e38f)) {
    const double wide = span > 0.0f ? (double)units / (double)span : 0.0;
    for (int n = 0; n < 512; ++n) {
        const double scaled = (double)(values[n] - low) * wide + (double)rounding.data[n];
        codes[n] = (unsigned short)(int)(scaled < (double)units ? scaled : (double)units);
    }
} else {
    for (int n = 0; n < 512; ++n) {
        const float scaled = (values[n] - low) * scale + rounding.data[n];
        codes[n] = (unsigned short)(int)(scaled < (float)units ? scaled : (float)units);
    }
}
// Readers round product and sum one after the other, or fuse them: the larger error counts.
double errors[8], worst = 0.0;
for (int k = 0; k < 8; ++k) errors[k] = 0.0;
for (int n = 0; n < 512; n += 8) {
    for (int k = 0; k < 8; ++k) {
        const int code = codes[n + k];
        const float product = (float)code * quantum, twice = product + low;
        const float fused = (float)((double)code * (double)quantum + (double)low);
        const double a = ::fabs((double)twice - (double)values[n + k]);
        const double b = ::fabs((double)fused - (double)values[n + k]);
        const double larger = a > b ? a : b;
        errors[k] = larger > errors[k] ? larger : errors[k];
    }
}
for (int k = 0; k < 8; ++k) worst = errors[k] > worst ? errors[k] : worst;
// A span beyond float32 makes NaN, and so does a value that is not finite.
if (!(span <= 3.402823466e38f)) worst = 1.0e300;
for (int k = 0; k < 8; ++k) worst = nothing[k] == 0.0f ? worst : -1.0;
