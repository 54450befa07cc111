// Sorts `count` values from `begin` on, in place: Shell sort, gaps of Tokuda 1992.
//
// Expects values, begin, count.

int64_t* const row = values.data + begin;
int gap = count;
while (gap > 1) {
    gap = gap <= 32 ? 1 : gap / 9 * 4;
    for (int i = gap; i < count; ++i) {
        const int64_t moving = row[i];
        int j = i;
        for (; j >= gap && row[j - gap] > moving; j -= gap) row[j] = row[j - gap];
        row[j] = moving;
    }
}
