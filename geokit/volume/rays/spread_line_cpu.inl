// A line of blocks along z of spread_distance_kernel, in a loop over bytes that compilers vectorize. Read as unsigned
// bytes, the border's -1 counts as far away.
//
// Expects line, total, stride, count, length, distance, out_distance; the constant FARTHEST.
typedef unsigned char byte;
const int lines = total / length, part = line / lines, first = (line - part * lines) * length;
const byte* const in = (const byte*)distance.data + (long long)(part >> 1) * total + first;
byte* const out = (byte*)out_distance.data + (long long)part * total + first;
const bool back = part & 1;
for (int k = 0; k < length; ++k) out[k] = in[k];
auto see = [](byte* to, const byte* from, int r, int n) {
    for (int k = 0; k < n; ++k) {
        const byte other = from[k] > (byte)r ? from[k] : (byte)r;
        to[k] = to[k] < other ? to[k] : other;
    }
};
const int i = first / stride % count, ahead = stride == 1 ? length - 1 : back ? i : count - 1 - i;
const long long step = back ? -(long long)stride : (long long)stride;
for (int r = 1; r < FARTHEST && r <= ahead; ++r) {
    if (stride > 1) see(out, in + r * step, r, length);
    else if (back) see(out + r, in, r, length - r);
    else see(out, in + r, r, length - r);
}
for (int k = 0; k < length; ++k) out[k] = in[k] == 255 ? in[k] : out[k];
