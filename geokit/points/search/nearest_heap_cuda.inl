// The k nearest points on a GPU: a list of any length, as a heap in the rows of the result with the farthest on top.
//
// Expects nearest_query_cuda.inl. Defines offer(given, index) and finish.

auto sift = [&](int size, double given, int index) {
    int at = 0;
    for (;;) {
        int child = 2 * at + 1;
        if (child >= size) break;
        if (child + 1 < size && before(row[child], indices[child], row[child + 1], indices[child + 1])) ++child;
        if (!before(given, index, row[child], indices[child])) break;
        row[at] = row[child];
        indices[at] = indices[child];
        at = child;
    }
    row[at] = given;
    indices[at] = index;
};
for (int i = 0; i < k; ++i) {
    row[i] = limit;
    indices[i] = NONE;
}
auto offer = [&](double given, int index) {
    sift(k, given, index);
    bound = row[0];
    bound_index = indices[0];
};
auto finish = [&]() {
    for (int size = k - 1; size > 0; --size) {
        const double given = row[size];
        const int index = indices[size];
        row[size] = row[0];
        indices[size] = indices[0];
        sift(size, given, index);
    }
    for (int i = 0; i < k; ++i) {
        row[i] = indices[i] == NONE ? infinite : sqrt(row[i]);
        if (indices[i] == NONE) indices[i] = -1;
    }
};
