// Replaces the links of a row of 8^3 cells by the names of their components, 0 for cells that are not set.
//
// Expects words, row, names, out_links. The first cell of a component within its row holds -1 minus the number of the
// component; the others link to it, so it has its name before they read it.

const unsigned long long* const plane = (const unsigned long long*)words.data + 8 * row;
int* const link = out_links.data;
for (int x = 0; x < 8; ++x) {
    int* const out = link + 512 * row + 64 * x;
    for (int n = 0; n < 64; ++n) {
        if (!(plane[x] >> n & 1ull)) out[n] = 0;
        else out[n] = out[n] < 0 ? names.data[-1 - out[n]] : link[out[n]];
    }
}
