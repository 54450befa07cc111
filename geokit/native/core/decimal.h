// Rows of decimal numbers in text: parsing, one chunk of the text at a time, and writing.
//
// Only plain rows are parsed: digits with a sign, a point and an exponent, or "nan", between separators. Anything else
// is reported, so that the caller can use a slower reader.
#pragma once

#include <cstdint>

namespace geokit {

// A range of text that is split into chunks. A chunk [first, last) owns the lines that begin in it: the first chunk
// begins with the range, every other one after the first line end at or after the byte before it.
struct Text {
    const char* data;
    std::int64_t start, stop;
};

// Number of lines of the chunk that are not only white space.
std::int64_t count_rows(const Text& text, std::int64_t first, std::int64_t last);

// Fills `table`, which has room for `size` numbers, with the rows of the chunk, `columns` numbers each. A `separator`
// of 0 means white space. A number that from_chars reports as out of range (overflow, underflow) becomes a NaN whose
// lower 51 bits are its position in the text plus one.
//
// Returns false if a row is not plain, or if the rows do not fill the table exactly.
bool parse_rows(const Text& text, std::int64_t first, std::int64_t last, std::int64_t columns, char separator,
    double* table, std::int64_t size);

// Characters of a row's pattern that stand for its next 64 bits, by their type.
enum Place : char { float64_place, int64_place, uint64_place, places };
// No number takes more characters: -2.2250738585072014e-308.
constexpr std::int64_t longest_number = 24;

// Writes `pattern` with its numbers for each row of `table`, and returns the number of characters. Floats are as in
// Python: the fewest digits that read back as the same number, with an exponent below 1e-4 and from 1e16 on.
std::int64_t write_rows(
    const std::uint64_t* table, std::int64_t rows, const char* pattern, std::int64_t pattern_size, char* out);

} // namespace geokit
