// Places of the candidates of each list of a share, from its beginning on, by ascending rank.
//
// Expects core/simd.inl, radius_runs_cpu.inl, radius_keep_cpu.inl, queries, grid, whose index are the ranks, offset, note
// (of radius_count_cpu.inl), note_size, share, first_query, last_query, out_place, RANKED and SHARE_SIZE.

#if !defined(__CUDA_ARCH__)
alignas(64) int found[room + 32], key[room + 32], rank[RANKED + 32];
int written[SHARE_SIZE];
for (int k = first_query; k < last_query; ++k) written[k - first_query] = 0;
auto put = [&](int k, const int* found, int count) {
    int& so_far = written[k - first_query];
    int* const places = out_place.data + offset.data[queries.index.data[k]];
    if (so_far == 0 && count <= RANKED) {
        // See radius_fill_cpu.inl.
        #pragma clang loop vectorize(disable)
        for (int i = 0; i < count; ++i) key[i] = grid.index.data[found[i]];
        *(i16*)(key + count) = (i16)(0x7fffffff);
        for (int at = 0; at < count; at += 32) {
            const i16 low = *(const i16*)(key + at), high = *(const i16*)(key + at + 16);
            i16 low_rank = 0, high_rank = 0;
            for (int j = 0; j < count; ++j) {
                low_rank -= low > (i16)(key[j]);
                high_rank -= high > (i16)(key[j]);
            }
            *(i16*)(rank + at) = low_rank;
            *(i16*)(rank + at + 16) = high_rank;
        }
        #pragma clang loop vectorize(disable)
        for (int i = 0; i < count; ++i) places[rank[i]] = found[i];
    } else {
        for (int i = 0; i < count; ++i) places[so_far + i] = found[i];
        // Shell sort, gaps of Tokuda 1992.
        const int total = so_far + count;
        for (int gap = total; gap > 1;) {
            gap = gap <= 32 ? 1 : gap / 9 * 4;
            for (int i = gap; i < total; ++i) {
                const int moving = places[i], moving_key = grid.index.data[moving];
                int j = i;
                for (; j >= gap && grid.index.data[places[j - gap]] > moving_key; j -= gap) places[j] = places[j - gap];
                places[j] = moving;
            }
        }
    }
    so_far += count;
};
const int64_t begin = (int64_t)(share)*note_size;
const int* at = note.data + begin;
if (begin < note.shape[0] && *at++)
    for (int k = first_query; k < last_query; ++k) {
        const int count = *at++;
        if (count) put(k, at, count);
        at += count;
    }
else
    each_run([&](int k, int length) {
        int count = 0;
        for (int at = 0; at < length; at += 16) count += keep(found + count, at, within(k, at));
        put(k, found, count);
    });
#endif
