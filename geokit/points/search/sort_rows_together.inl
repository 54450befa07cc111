// Sorts a row of neighbors by ascending index, with the 32 threads of a CUDA warp.
//
// Expects sort_by_index.inl, begin, count, lane, index, distance.
//
// Each thread counts the smaller entries for every entry it holds. On a CPU there is one thread: the first of the 32
// items sorts the row.

#if defined(__CUDA_ARCH__)
int* const keys = index.data + begin;
double* const values = distance.data + begin;
constexpr int held = 4;
int mine[held], rank[held];
double far[held];
if (count > 32 * held) {
    if (lane == 0) sort_row(keys, values, count);
    return;
}
for (int h = 0; h < held; ++h) {
    const int at = lane + 32 * h;
    rank[h] = 0;
    mine[h] = at < count ? keys[at] : 0x7fffffff;
    far[h] = at < count ? values[at] : 0.0;
}
for (int h = 0; 32 * h < count; ++h)
    for (int source = 0; source < 32; ++source) {
        const int other = __shfl_sync(0xffffffffu, mine[h], source);
        for (int own = 0; own < held; ++own) rank[own] += other < mine[own];
    }
// Every entry has been read before any is written.
__syncwarp();
for (int h = 0; h < held; ++h)
    if (lane + 32 * h < count) {
        keys[rank[h]] = mine[h];
        values[rank[h]] = far[h];
    }
#else
if (lane == 0) sort_row(index.data + begin, distance.data + begin, count);
#endif
