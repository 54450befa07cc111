// Puts the low bits of each key of a share, and the number of its point, into its bucket: a counting sort's last step.
//
// Expects begin, share, keys, places, out_pairs, BUCKETS, LOW_BITS. Moves the places on.

const int count = keys.shape[0], end = begin + share < count ? begin + share : count;
int* const place = places.data + begin / share * BUCKETS;
for (int i = begin; i < end; ++i) {
    const unsigned key = keys.data[i];
    out_pairs.data[place[key >> LOW_BITS]++] = (wp::uint64)(key & ((1u << LOW_BITS) - 1u)) << 32 | (unsigned)i;
}
