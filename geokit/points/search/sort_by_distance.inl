// Sorts `count` neighbors from `begin` on by ascending (distance, index), in place: Shell sort, gaps of Tokuda 1992.
//
// Expects begin, count, index, distance.

int* const key = index.data + begin;
double* const value = distance.data + begin;
auto before = [](double d, int i, double e, int j) { return d < e || (d == e && i < j); };
int gap = count;
while (gap > 1) {
    gap = gap <= 32 ? 1 : gap / 9 * 4;
    for (int i = gap; i < count; ++i) {
        const int moving = key[i];
        const double moving_value = value[i];
        int j = i;
        for (; j >= gap && before(moving_value, moving, value[j - gap], key[j - gap]); j -= gap) {
            key[j] = key[j - gap];
            value[j] = value[j - gap];
        }
        key[j] = moving;
        value[j] = moving_value;
    }
}
