// Writes a leaf's codes and statistics. These count steps from the minimum and are those of the active voxels.
//
// Expects quantize_leaf.inl, source, start, bits, flags, target, to. Returns the largest error, and the smallest and
// the largest active value.

unsigned char* leaf = target.data + to;
for (int n = 0; n < 80; ++n) leaf[n] = source.data[start + n];
leaf[15] = (unsigned char)((leaf[15] & 0x1f) | flags);
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
return wp::vec_t<3, double>(worst, some ? (double)first : 1.0e300, some ? (double)last : -1.0e300);
