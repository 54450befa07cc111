// Neighbors of each query of a share, from its offset on: by ascending index (BY_INDEX), or in the order of the cells.
//
// Expects core/simd.inl, radius_runs_cpu.inl, radius_keep_cpu.inl, sort_by_index.inl, queries, grid, own, offset, note
// (of radius_count_cpu.inl), note_size, share, first_query, last_query, out_index, out_distance and the constants of
// radius_cpu_kernels.

#if !defined(__CUDA_ARCH__)
// Neighbors found in one filling of the buffer: their positions among the sorted points, indices and distances.
alignas(64) int found[room + 32], key[room + 32], rank[RANKED + 32];
alignas(64) double distance[room + 32];
int written[SHARE_SIZE];
// Rows are in the caller's order, scattered over memory, so the rows of upcoming queries are prefetched.
for (int k = first_query; k < last_query; ++k) {
    written[k - first_query] = 0;
    __builtin_prefetch(offset.data + queries.index.data[k]);
}
auto put = [&](int k, const int* found, int count) {
    const int row = queries.index.data[k], without = row + own;
    if (k + AHEAD < last_query) {
        // Prefetch all cache lines of a row, which seldom begins at a line.
        const int next = queries.index.data[k + AHEAD];
        const int64_t row_begin = offset.data[next], length = offset.data[next + 1] - row_begin;
        const int64_t most = length < PREFETCHED ? length : PREFETCHED;
        auto prefetch = [&](const auto* first) {
            const char* const end = (const char*)(first + most) + 63;
            for (const char* line = (const char*)(first); line < end; line += 64) __builtin_prefetch(line, 1);
        };
        prefetch(out_index.data + row_begin);
        prefetch(out_distance.data + row_begin);
    }
    const double x = queries.x.data[k], y = queries.y.data[k], z = queries.z.data[k];
    // Vectorization is off: the compiler would gather here and scatter below. On processors with the microcode
    // mitigation a gather takes ten times as long, and no processor gains from the scatter.
    #pragma clang loop vectorize(disable)
    for (int i = 0; i < count; ++i) {
        const int p = found[i];
        const double dx = grid.x.data[p] - x, dy = grid.y.data[p] - y, dz = grid.z.data[p] - z;
        key[i] = grid.index.data[p];
        distance[i] = (dx * dx + dy * dy) + dz * dz;
    }
    int kept = count;
    if (own >= 0) {
        kept = 0;
        for (int i = 0; i < count; ++i)
            if (key[i] != without) {
                key[kept] = key[i];
                distance[kept++] = distance[i];
            }
    }
    for (int i = 0; i < kept; i += 8) *(d8*)(distance + i) = __builtin_elementwise_sqrt(*(const d8*)(distance + i));
    int& so_far = written[k - first_query];
    int* const keys = out_index.data + offset.data[row];
    auto* const values = out_distance.data + offset.data[row];
    if (BY_INDEX && so_far == 0 && kept <= RANKED) {
        // A short row is sorted by counting, for each entry, the smaller ones, sixteen entries at a time: no branch
        // depends on the data.
        *(i16*)(key + kept) = (i16)(0x7fffffff);
        for (int at = 0; at < kept; at += 32) {
            const i16 low = *(const i16*)(key + at), high = *(const i16*)(key + at + 16);
            i16 low_rank = 0, high_rank = 0;
            for (int j = 0; j < kept; ++j) {
                low_rank -= low > (i16)(key[j]);
                high_rank -= high > (i16)(key[j]);
            }
            *(i16*)(rank + at) = low_rank;
            *(i16*)(rank + at + 16) = high_rank;
        }
        #pragma clang loop vectorize(disable)
        for (int i = 0; i < kept; ++i) {
            keys[rank[i]] = key[i];
            values[rank[i]] = distance[i];
        }
    } else {
        for (int i = 0; i < kept; ++i) {
            keys[so_far + i] = key[i];
            values[so_far + i] = distance[i];
        }
        if (BY_INDEX) sort_row(keys, values, so_far + kept);
    }
    so_far += kept;
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
