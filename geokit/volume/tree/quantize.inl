// Float leaves as codes: see quantize_kernels.

// A float leaf as codes of `bits` bits, bit for bit as NanoVDB writes them. Returns their largest error, -1 if a value
// is not finite.
//
// In C++, because warp has no local arrays of this size. Minima and maxima run in eight lanes, which the compiler does
// not make of one.
static constexpr auto codes_of = [](const wp::array_t<uint8_t>& source, long long start, int bits,
                                    const wp::array_t<float>& rounding, unsigned short* codes, float& low,
                                    float& quantum) -> double {
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
    low = lows[0];
    float high = highs[0];
    for (int k = 1; k < 8; ++k) {
        low = lows[k] < low ? lows[k] : low;
        high = highs[k] > high ? highs[k] : high;
    }
    const float span = high - low;
    quantum = span / (float)units;
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
    return worst;
};

// Largest error of a leaf's values as codes of `bits` bits, -1 if a value is not finite.
// Smallest width in bits that keeps a leaf's error within its tolerance, 16 if none does.
static constexpr auto fewest_bits = [](int item, const wp::array_t<uint8_t>& source, const wp::array_t<int64_t>& starts,
                                       const wp::array_t<double>& tolerance, const wp::array_t<float>& rounding,
                                       wp::array_t<uint8_t>& out_bits) {
    unsigned short codes[512];
    float low, quantum;
    int bits = 1;
    while (bits < 16 && codes_of(source, starts.data[item], bits, rounding, codes, low, quantum) > tolerance.data[item])
        bits *= 2;
    out_bits.data[item] = (uint8_t)bits;
};

// Writes a leaf's codes and statistics. These count steps from the minimum and are those of the active voxels. Measures
// are the largest error, and the smallest and the largest active value.
static constexpr auto write_leaf = [](int item, const wp::array_t<uint8_t>& source, const wp::array_t<int64_t>& starts,
                                      const wp::array_t<uint8_t>& widths, const wp::array_t<uint8_t>& flags,
                                      const wp::array_t<float>& rounding, const wp::array_t<int64_t>& places,
                                      wp::array_t<uint8_t>& target, wp::array_t<wp::vec3d>& out_measures) {
    const long long start = starts.data[item];
    const int bits = widths.data[item];
    unsigned short codes[512];
    float low, quantum;
    const double worst = codes_of(source, start, bits, rounding, codes, low, quantum);
    unsigned char* leaf = target.data + places.data[item];
    for (int n = 0; n < 80; ++n) leaf[n] = source.data[start + n];
    leaf[15] = (unsigned char)((leaf[15] & 0x1f) | flags.data[item]);
    unsigned short least = 65535, most = 0;
    bool some = false;
    for (int n = 0; n < 512; ++n) {
        if (leaf[16 + n / 8] >> (n & 7) & 1) {
            some = true;
            least = codes[n] < least ? codes[n] : least;
            most = codes[n] > most ? codes[n] : most;
        }
    }
    if (!some) least = 0;
    const float* given = (const float*)(source.data + start + 88);
    double mean = ((double)given[0] - (double)low) / (double)quantum + 0.5;
    double spread = (double)given[1] / (double)quantum + 0.5;
    mean = mean >= 0.0 && mean <= 65535.0 ? mean : 0.0;
    spread = spread >= 0.0 && spread <= 65535.0 ? spread : 0.0;
    float* steps = (float*)(leaf + 80);
    steps[0] = low;
    steps[1] = quantum;
    unsigned short* statistics = (unsigned short*)(leaf + 88);
    statistics[0] = least;
    statistics[1] = most;
    statistics[2] = (unsigned short)(int)mean;
    statistics[3] = (unsigned short)(int)spread;
    if (bits == 16) {
        unsigned short* table = (unsigned short*)(leaf + 96);
        for (int n = 0; n < 512; ++n) table[n] = codes[n];
    } else {
        const int each = 8 / bits;
        for (int n = 0; n < 512 / each; ++n) {
            unsigned packed = 0;
            for (int k = 0; k < each; ++k) packed |= (unsigned)codes[n * each + k] << (bits * k);
            leaf[96 + n] = (unsigned char)packed;
        }
    }
    const float first = (float)least * quantum + low, last = (float)most * quantum + low;
    out_measures.data[item] = wp::vec3d(worst, some ? (double)first : 1.0e300, some ? (double)last : -1.0e300);
};
