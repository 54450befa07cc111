// Verlet lists on a CPU.
#include "points/search/radius_cpu.inl"

// Places of the candidates of each list of a share, from its beginning on, by ascending rank, which is grid.index.
static constexpr auto list_places = [](int share, const Queries& queries, const CellGrid& grid,
                                       const wp::array_t<double>& radius, const wp::array_t<int64_t>& offset,
                                       int note_size, const wp::array_t<int>& note, wp::array_t<int>& out_place) {
    const int first_query = share * SHARE_SIZE, last_query = wp::min(first_query + SHARE_SIZE, queries.index.shape[0]);
    alignas(64) int key[room + 32], rank[RANKED + 32];
    int written[SHARE_SIZE];
    for (int k = first_query; k < last_query; ++k) written[k - first_query] = 0;
    auto put = [&](int k, const int* found, int count) {
        int& so_far = written[k - first_query];
        int* const places = out_place.data + offset.data[queries.index.data[k]];
        if (so_far == 0 && count <= RANKED) {
            // See fill_share.
            #pragma clang loop vectorize(disable)
            for (int i = 0; i < count; ++i) key[i] = grid.index.data[found[i]];
            rank_keys(key, count, rank);
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
                    for (; j >= gap && grid.index.data[places[j - gap]] > moving_key; j -= gap)
                        places[j] = places[j - gap];
                    places[j] = moving;
                }
            }
        }
        so_far += count;
    };
    each_found(queries, grid, radius, note, note_size, share, first_query, last_query, put);
};
