// Number of neighbors of each query of a share. The neighbors found are noted for the fill, as long as there is space.
//
// Expects radius_runs_cpu.inl, radius_keep_cpu.inl, queries, self_count, note_size, share, first_query, last_query,
// out_count, out_note.
//
// The notes hold, for each query, the number of neighbors and their positions among the sorted points. The first entry
// is 1 if the notes of all queries of the share are complete.

#if !defined(__CUDA_ARCH__)
const int64_t begin = (int64_t)(share)*note_size;
bool whole = begin < out_note.shape[0];
// Where there is no room for notes, there may be no array: no pointer is formed then.
int* to = whole ? out_note.data + begin + 1 : nullptr;
const int* const end = whole ? out_note.data + begin + note_size : nullptr;
int next = first_query;
for (int k = first_query; k < last_query; ++k) out_count.data[queries.index.data[k]] = -self_count;
// Queries come in order; those without candidates are skipped. If the candidates fill the buffer several times, all
// queries of the run come once for each filling, and nothing is noted.
each_run([&](int k, int length) {
    whole = whole && k >= next && to + (k - next) + 1 + length <= end;
    int inside = 0;
    if (whole) {
        for (; next < k; ++next) *to++ = 0;
        int* const found = to + 1;
        for (int at = 0; at < length; at += 16) inside += keep(found + inside, at, within(k, at));
        *to = inside;
        to = found + inside;
        ++next;
    } else
        for (int at = 0; at < length; at += 16) inside += __builtin_popcount(within(k, at));
    out_count.data[queries.index.data[k]] += inside;
});
if (begin < out_note.shape[0]) {
    whole = whole && to + (last_query - next) <= end;
    for (; whole && next < last_query; ++next) *to++ = 0;
    out_note.data[begin] = whole;
}
#endif
