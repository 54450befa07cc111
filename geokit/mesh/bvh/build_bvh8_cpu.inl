// Builds the CPU tree: a range of references is split in two by a binned surface area heuristic, and a node is formed
// by splitting its largest range again until it has eight.
//
// A reference is eight floats: lower x y z, triangle, upper x y z, unused. Expects core/simd.inl; references, boxes;
// BINS, WIDTH. Defines Range; empty(range), add(range, i), split(range, halve, left, right); open(range, halve, child),
// which returns the number of children; write(node, child, count). Also defines data, HUGE_BOX, area and swap.
#if !defined(__CUDA_ARCH__)
struct Range {
    int begin, end;
    v4 lower, upper, low_center, high_center;
};
v4* data = (v4*)references.data;
const float HUGE_BOX = 3e38f;
auto empty = [&](Range& r) {
    r.lower = HUGE_BOX;
    r.upper = -HUGE_BOX;
    r.low_center = HUGE_BOX;
    r.high_center = -HUGE_BOX;
};
auto add = [&](Range& r, int i) {
    const v4 l = data[2 * i], u = data[2 * i + 1], c = l + u;
    r.lower = __builtin_elementwise_min(r.lower, l);
    r.upper = __builtin_elementwise_max(r.upper, u);
    r.low_center = __builtin_elementwise_min(r.low_center, c);
    r.high_center = __builtin_elementwise_max(r.high_center, c);
};
auto area = [](const v4& l, const v4& u) {
    const v4 e = u - l;
    return e.x * e.y + e.y * e.z + e.z * e.x;
};
auto swap = [&](int i, int j) {
    const v4 l = data[2 * i], u = data[2 * i + 1];
    data[2 * i] = data[2 * j];
    data[2 * i + 1] = data[2 * j + 1];
    data[2 * j] = l;
    data[2 * j + 1] = u;
};
// Splits a range into two non-empty ones at the cheapest plane between bins; costs count blocks of a leaf.
auto split = [&](const Range& range, bool halve, Range& left, Range& right) {
    const int count = range.end - range.begin;
    const v4 extent = range.high_center - range.low_center;
    const int bins = count < 64 ? BINS / 2 : BINS;
    int best_axis = -1, best_bin = 0;
    v4 factor;
    for (int k = 0; k < 3; ++k) factor[k] = extent[k] > 1e-30f ? bins * 0.9999f / extent[k] : 0.f;
    factor.w = 0.f;
    if (!halve && (factor.x > 0.f || factor.y > 0.f || factor.z > 0.f)) {
        v4 low[3][BINS], high[3][BINS];
        int filled[3][BINS];
        for (int k = 0; k < 3; ++k)
            for (int b = 0; b < bins; ++b) {
                low[k][b] = HUGE_BOX;
                high[k][b] = -HUGE_BOX;
                filled[k][b] = 0;
            }
        for (int i = range.begin; i < range.end; ++i) {
            const v4 l = data[2 * i], u = data[2 * i + 1], at = (l + u - range.low_center) * factor;
            for (int k = 0; k < 3; ++k) {
                const int b = (int)at[k];
                low[k][b] = __builtin_elementwise_min(low[k][b], l);
                high[k][b] = __builtin_elementwise_max(high[k][b], u);
                ++filled[k][b];
            }
        }
        float best = HUGE_BOX;
        for (int k = 0; k < 3; ++k) {
            if (factor[k] == 0.f) continue;
            float cost[BINS];
            v4 l = HUGE_BOX, u = -HUGE_BOX;
            int n = 0;
            for (int b = bins - 1; b > 0; --b) {
                l = __builtin_elementwise_min(l, low[k][b]);
                u = __builtin_elementwise_max(u, high[k][b]);
                n += filled[k][b];
                cost[b] = n ? area(l, u) * ((n + 7) >> 3) : HUGE_BOX;
            }
            l = HUGE_BOX;
            u = -HUGE_BOX;
            n = 0;
            for (int b = 1; b < bins; ++b) {
                l = __builtin_elementwise_min(l, low[k][b - 1]);
                u = __builtin_elementwise_max(u, high[k][b - 1]);
                n += filled[k][b - 1];
                if (n == 0 || cost[b] == HUGE_BOX) continue;
                const float whole = cost[b] + area(l, u) * ((n + 7) >> 3);
                if (whole < best) {
                    best = whole;
                    best_axis = k;
                    best_bin = b;
                }
            }
        }
    }
    empty(left);
    empty(right);
    int middle;
    if (best_axis >= 0) {
        int i = range.begin, j = range.end;
        while (i < j) {
            const v4 at = (data[2 * i] + data[2 * i + 1] - range.low_center) * factor;
            if ((int)at[best_axis] < best_bin) {
                add(left, i);
                ++i;
            } else {
                --j;
                swap(i, j);
                add(right, j);
            }
        }
        middle = i;
    } else {
        middle = range.begin + count / 2;
        for (int i = range.begin; i < middle; ++i) add(left, i);
        for (int i = middle; i < range.end; ++i) add(right, i);
    }
    left.begin = range.begin;
    left.end = middle;
    right.begin = middle;
    right.end = range.end;
};
// Splits a range into the children of one node; returns their number.
auto open = [&](const Range& range, bool halve, Range* child) {
    int count = 1;
    child[0] = range;
    while (count < WIDTH) {
        int largest = -1;
        float most = -1.f;
        for (int c = 0; c < count; ++c) {
            if (child[c].end - child[c].begin <= WIDTH) continue;
            const float a = area(child[c].lower, child[c].upper);
            if (a > most || largest < 0) {
                most = a;
                largest = c;
            }
        }
        if (largest < 0) break;
        const Range whole = child[largest];
        split(whole, halve, child[largest], child[count]);
        ++count;
    }
    return count;
};
auto write = [&](int node, const Range* child, int count) {
    for (int c = 0; c < WIDTH; ++c)
        for (int k = 0; k < 3; ++k) {
            boxes.data[node * 48 + k * 8 + c] = c < count ? child[c].lower[k] : 3e38f;
            boxes.data[node * 48 + 24 + k * 8 + c] = c < count ? child[c].upper[k] : -3e38f;
        }
};
#endif
