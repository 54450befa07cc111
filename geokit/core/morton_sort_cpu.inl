// Sorts the points of a bucket by the low bits of their keys, digit by digit from the lowest on.
//
// Expects bucket, start, pairs, spare, out_order, LOW_BITS, MANY, FEW.

const int begin = start.data[bucket], n = start.data[bucket + 1] - begin;
if (n == 0) return;
wp::uint64 *from = pairs.data + begin, *to = spare.data + begin;
int* const order = out_order.data + begin;
if (n < FEW) {
    for (int i = 1; i < n; ++i) {
        const wp::uint64 pair = from[i];
        int at = i;
        for (; at > 0 && from[at - 1] > pair; --at) from[at] = from[at - 1];
        from[at] = pair;
    }
    for (int i = 0; i < n; ++i) order[i] = (int)(unsigned)from[i];
    return;
}
const int width = n < MANY ? LOW_BITS / 3 : LOW_BITS / 2, passes = LOW_BITS / width;
const unsigned mask = (1u << width) - 1u;
int counts[3][1 << LOW_BITS / 2];
for (int pass = 0; pass < passes; ++pass)
    for (unsigned digit = 0; digit <= mask; ++digit) counts[pass][digit] = 0;
for (int i = 0; i < n; ++i)
    for (int pass = 0; pass < passes; ++pass) ++counts[pass][(unsigned)(from[i] >> 32) >> width * pass & mask];
for (int pass = 0; pass < passes; ++pass) {
    int* const place = counts[pass];
    for (unsigned digit = 0, at = 0; digit <= mask; ++digit) {
        const int more = place[digit];
        place[digit] = at;
        at += more;
    }
    if (pass + 1 == passes) {
        for (int i = 0; i < n; ++i)
            order[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = (int)(unsigned)from[i];
        return;
    }
    for (int i = 0; i < n; ++i) to[place[(unsigned)(from[i] >> 32) >> width * pass & mask]++] = from[i];
    wp::uint64* const other = from;
    from = to;
    to = other;
}
