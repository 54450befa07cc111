// The k nearest points on a GPU: a list of LENGTH entries in registers, sorted by (squared distance, index).
//
// Expects nearest_query_cuda.inl, LENGTH. Defines offer(given, index) and finish.
//
// The loops have constant bounds: unrolled, everything stays in registers. A shorter list begins with entries that
// precede every candidate, so that the last entry is always the k-th.

const int K = LENGTH;
double squared[K];
int candidate[K];
#pragma unroll
for (int i = 0; i < K; ++i) {
    squared[i] = i < K - k ? -1.0 : limit;
    candidate[i] = i < K - k ? -1 : NONE;
}
auto offer = [&](double given, int index) {
    // Entries before the new one stay; the new one replaces the first other entry, and the rest move up by one.
    #pragma unroll
    for (int i = K - 1; i > 0; --i) {
        const bool moves = before(given, index, squared[i - 1], candidate[i - 1]);
        const bool enters = before(given, index, squared[i], candidate[i]);
        squared[i] = moves ? squared[i - 1] : enters ? given : squared[i];
        candidate[i] = moves ? candidate[i - 1] : enters ? index : candidate[i];
    }
    if (before(given, index, squared[0], candidate[0])) {
        squared[0] = given;
        candidate[0] = index;
    }
    bound = squared[K - 1];
    bound_index = candidate[K - 1];
};
auto finish = [&]() {
    #pragma unroll
    for (int i = 0; i < K; ++i)
        if (i >= K - k) {
            row[i - (K - k)] = candidate[i] == NONE ? infinite : sqrt(squared[i]);
            indices[i - (K - k)] = candidate[i] == NONE ? -1 : candidate[i];
        }
};
