// The k nearest points on a CPU: eight queries, their bounds and their lists of candidates.
//
// Expects core/simd.inl, queries, the constants of nearest_cpu_kernels, and SORT_SIXTEEN and MERGE_SIXTEEN: sorting
// networks for the sixteen values s with the candidates m, made of exchange(s[a], m[a], s[b], m[b]). Defines the state
// of the eight queries, settle and put_back.
//
// Candidates are buffered in a row for each query. For sorting they are transposed to lanes, one for each query, where
// a sorting network makes the same comparisons whatever the values: no branch is mispredicted. Groups of sixteen are
// sorted in registers, then merged.

#if !defined(__CUDA_ARCH__)
// Type of the result of comparing doubles: long if that has 64 bits, else long long.
typedef decltype(__builtin_reduce_max(d8() < d8())) i64;
typedef i64 long8 __attribute__((ext_vector_type(8), aligned(8)));
const int k = queries.k;
double q[3][8], bound[8], reach[8], limit[8];
i64 bound_index[8];
int owner[8], self[8];
double row_squared[8][CAPACITY];
i64 row_candidate[8][CAPACITY];
alignas(64) d8 squared[CAPACITY];
alignas(64) long8 candidate[CAPACITY];
const int room = k + (k < 256 ? k : 256) + 2 * LEAF + 16;
int size[8];
auto by_distance = [](d8& s, long8& m, d8& t, long8& o) {
    const long8 swap = t < s;
    const d8 u = t < s ? t : s;
    t = t < s ? s : t;
    s = u;
    const long8 v = swap ? o : m;
    o = swap ? m : o;
    m = v;
};
auto by_both = [](d8& s, long8& m, d8& t, long8& o) {
    const long8 swap = (t < s) | ((t == s) & (o < m));
    const d8 u = swap ? t : s;
    t = swap ? s : t;
    s = u;
    const long8 v = swap ? o : m;
    o = swap ? m : o;
    m = v;
};
// Transposes eight rows to lanes, or lanes to rows.
auto turned = [](const d8* r, d8* out) {
    d8 a[8], b[8];
    #pragma unroll
    for (int i = 0; i < 4; ++i) {
        a[i] = __builtin_shufflevector(r[i], r[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        a[i + 4] = __builtin_shufflevector(r[i], r[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
    #pragma unroll
    for (int i = 0; i < 8; i += 4)
        for (int l = 0; l < 2; ++l) {
            b[i + l] = __builtin_shufflevector(a[i + l], a[i + l + 2], 0, 1, 8, 9, 4, 5, 12, 13);
            b[i + l + 2] = __builtin_shufflevector(a[i + l], a[i + l + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        }
    #pragma unroll
    for (int i = 0; i < 8; i += 2) {
        out[i] = __builtin_shufflevector(b[i], b[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
        out[i + 1] = __builtin_shufflevector(b[i], b[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
};
auto sort = [&](int n, auto exchange) {
    for (int i = 0; i < n; i += 16) {
        d8 s[16];
        long8 m[16];
        for (int l = 0; l < 16; ++l) {
            s[l] = squared[i + l];
            m[l] = candidate[i + l];
        }
        SORT_SIXTEEN
        for (int l = 0; l < 16; ++l) {
            squared[i + l] = s[l];
            candidate[i + l] = m[l];
        }
    }
    for (int half = 16; half < n; half *= 2) {
        // The last merge is needed up to k only.
        const int end = 2 * half < n || n < k ? n : k;
        // Move the smaller values of two sorted runs to the first run. All entries beyond n are infinite.
        for (int base = 0; base + half < n; base += 2 * half)
            for (int i = 2 * half < n - base ? 0 : 2 * half - (n - base); i < half; ++i)
                exchange(squared[base + i], candidate[base + i], squared[base + 2 * half - 1 - i],
                         candidate[base + 2 * half - 1 - i]);
        for (int step = half / 2; step >= 16; step /= 2)
            for (int base = 0; base < end; base += 2 * step)
                for (int i = base; i < base + step && i + step < n; ++i)
                    exchange(squared[i], candidate[i], squared[i + step], candidate[i + step]);
        for (int i = 0; i < end; i += 16) {
            d8 s[16];
            long8 m[16];
            for (int l = 0; l < 16; ++l) {
                s[l] = squared[i + l];
                m[l] = candidate[i + l];
            }
            MERGE_SIXTEEN
            for (int l = 0; l < 16; ++l) {
                squared[i + l] = s[l];
                candidate[i + l] = m[l];
            }
        }
    }
};
// Sorts the candidates in lanes, tightens the bounds and drops the candidates beyond the k-th.
auto settle = [&]() {
    int most = 0;
    for (int j = 0; j < 8; ++j) most = size[j] > most ? size[j] : most;
    const int n = (most + 15) / 16 * 16;
    for (int j = 0; j < 8; ++j)
        for (int i = size[j]; i < n; ++i) {
            row_squared[j][i] = INFINITY;
            row_candidate[j][i] = NONE;
        }
    for (int i = 0; i < n; i += 8) {
        d8 r[8];
        for (int j = 0; j < 8; ++j) r[j] = *(const d8*)(row_squared[j] + i);
        turned(r, squared + i);
        for (int j = 0; j < 8; ++j) r[j] = __builtin_bit_cast(d8, *(const long8*)(row_candidate[j] + i));
        turned(r, (d8*)(candidate + i));
    }
    sort(n, by_distance);
    // Ties among the kept candidates, or between the last of them and the dropped ones, are rare except on lattices.
    long8 tied = (long8)((i64)0);
    for (int i = 0; i + 1 < k && i + 1 < n; ++i)
        tied |= (squared[i] == squared[i + 1]) & (candidate[i] != candidate[i + 1]);
    for (int i = k; i < n; ++i) tied |= (squared[i] == squared[k - 1]) & (candidate[i] != candidate[k - 1]);
    if (mask_of(tied)) sort(n, by_both);
    for (int j = 0; j < 8; ++j)
        if (size[j] >= k) {
            size[j] = k;
            if (bound[j] >= 0.0) {
                bound[j] = squared[k - 1][j];
                bound_index[j] = candidate[k - 1][j];
            }
        }
};
// Transposes the kept candidates back to rows.
auto put_back = [&]() {
    for (int i = 0; i < k; i += 8) {
        d8 r[8];
        turned(squared + i, r);
        for (int j = 0; j < 8; ++j) *(d8*)(row_squared[j] + i) = r[j];
        turned((const d8*)(candidate + i), r);
        for (int j = 0; j < 8; ++j) *(long8*)(row_candidate[j] + i) = __builtin_bit_cast(long8, r[j]);
    }
};
#endif
