// Parsing of rows of decimal numbers in text, one chunk of the text at a time.
//
// Only plain rows are accepted: digits with a sign, a point and an exponent, or "nan", between separators. Anything
// else is reported, so that the caller can use a slower reader.
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

} // namespace geokit
