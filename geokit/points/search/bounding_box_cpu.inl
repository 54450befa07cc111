// Bounding box of the points of a share; not finite if one of the points is not.
//
// Eight consecutive points are three vectors of eight numbers, and lane e of vector v always belongs to the same axis.
// A sum of differences keeps a non-finite value; comparisons may skip it.
static constexpr auto box_of = [](int share, const auto& points, wp::array_t<wp::vec3d>& out_lower,
                                  wp::array_t<wp::vec3d>& out_upper) {
    const int begin = share * SHARE, end = wp::min(begin + SHARE, points.shape[0]);
    typedef decltype(points.data[0][0] + points.data[0][0]) real;
    typedef real numbers __attribute__((ext_vector_type(8), aligned(4)));
    const real* const given = (const real*)(points.data) + 3 * (int64_t)(begin);
    const int count = 3 * (end - begin);
    numbers low[3], high[3], rest[3];
    for (int v = 0; v < 3; ++v) {
        for (int e = 0; e < 8; ++e) low[v][e] = given[(8 * v + e) % 3];
        high[v] = low[v];
        rest[v] = low[v] - low[v];
    }
    int at = 0;
    for (; at + 24 <= count; at += 24)
        for (int v = 0; v < 3; ++v) {
            const numbers p = *(const numbers*)(given + at + 8 * v);
            low[v] = p < low[v] ? p : low[v];
            high[v] = p > high[v] ? p : high[v];
            rest[v] += p - p;
        }
    for (; at < count; ++at) {
        const int v = at % 24 / 8, e = at % 8;
        const real p = given[at];
        low[v][e] = p < low[v][e] ? p : low[v][e];
        high[v][e] = p > high[v][e] ? p : high[v][e];
        rest[v][e] += p - p;
    }
    for (int axis = 0; axis < 3; ++axis) {
        double lower = low[0][axis], upper = high[0][axis], total = 0.0;
        for (int k = axis; k < 24; k += 3) {
            lower = low[k / 8][k % 8] < lower ? low[k / 8][k % 8] : lower;
            upper = high[k / 8][k % 8] > upper ? high[k / 8][k % 8] : upper;
            total += rest[k / 8][k % 8];
        }
        out_lower.data[share][axis] = lower + total;
        out_upper.data[share][axis] = upper + total;
    }
};
