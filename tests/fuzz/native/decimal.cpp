// Rows of decimal numbers: any text, split at any place, must stay inside its bytes and give the rows of the whole; any
// bits, written as numbers, must stay inside their room.
#include "../../../geokit/native/core/decimal.h"

#include "exact.h"

#include <cstdlib>
#include <cstring>
#include <vector>

static void write(const Exact& bytes)
{
    std::vector<uint64_t> table(bytes.size() / 8);
    if (!table.empty()) std::memcpy(table.data(), bytes.data(), table.size() * 8);
    for (const char place : {geokit::float64_place, geokit::int64_place, geokit::uint64_place}) {
        Exact out(table.size() * size_t(geokit::longest_number));
        geokit::write_rows(table.data(), int64_t(table.size()), &place, 1, reinterpret_cast<char*>(out.data()));
    }
}

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size)
{
    if (size < 4) return 0;
    const int64_t columns = 1 + data[0] % 8;
    const char separator = data[1] % 2 ? ',' : '\0';
    const Exact bytes(data + 4, size - 4);
    write(bytes);
    const int64_t end = int64_t(bytes.size()), middle = (data[2] | data[3] << 8) % (end + 1);
    const geokit::Text text{reinterpret_cast<const char*>(bytes.data()), 0, end};

    const int64_t rows = geokit::count_rows(text, 0, end);
    const int64_t first = geokit::count_rows(text, 0, middle);
    if (first + geokit::count_rows(text, middle, end) != rows) std::abort();

    std::vector<double> table(size_t(rows * columns)), parts(table.size());
    if (!geokit::parse_rows(text, 0, end, columns, separator, table.data(), int64_t(table.size()))) return 0;
    const int64_t share = first * columns;
    if (!geokit::parse_rows(text, 0, middle, columns, separator, parts.data(), share)) std::abort();
    if (!geokit::parse_rows(text, middle, end, columns, separator, parts.data() + share, int64_t(parts.size()) - share))
        std::abort();
    // Bytes, because NaN is a value here.
    if (!table.empty() && std::memcmp(table.data(), parts.data(), table.size() * sizeof(double)) != 0) std::abort();
    return 0;
}
