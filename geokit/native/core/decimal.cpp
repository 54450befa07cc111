#include "decimal.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstring>
#include <system_error>

namespace geokit {

namespace {

constexpr std::uint64_t nan_bits = 0x7ff8000000000000u;
constexpr std::uint64_t sign_bit = 0x8000000000000000u;

double from_bits(std::uint64_t bits)
{
    double value;
    static_assert(sizeof value == sizeof bits);
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

bool is_digit(char c) { return c >= '0' && c <= '9'; }
bool is_blank(char c) { return c == ' ' || c == '\t'; }
// Case-insensitive comparison with an ASCII letter; other characters never compare equal to one.
bool is_letter(char c, char lower) { return (c | 32) == lower; }

const char* skip_blanks(const char* p, const char* end)
{
    while (p < end && is_blank(*p)) ++p;
    return p;
}

std::int64_t line_start(const Text& text, std::int64_t at)
{
    if (at <= text.start) return text.start;
    if (at >= text.stop) return text.stop;
    const void* found = std::memchr(text.data + at - 1, '\n', std::size_t(text.stop - at + 1));
    return found ? static_cast<const char*>(found) - text.data + 1 : text.stop;
}

// Reads one number and moves `p` past it; returns false if there is none.
bool parse_number(const char* text, const char*& p, const char* end, double& value)
{
    const char* const begin = p;
    const bool negative = p < end && *p == '-';
    if (p < end && (*p == '-' || *p == '+')) ++p;
    if (end - p >= 3 && is_letter(p[0], 'n') && is_letter(p[1], 'a') && is_letter(p[2], 'n')) {
        p += 3;
        value = from_bits(nan_bits | (negative ? sign_bit : 0));
        return true;
    }
    // from_chars also accepts "inf", "nan(...)" and a second minus sign.
    const bool digits = p < end && (is_digit(*p) || (*p == '.' && end - p >= 2 && is_digit(p[1])));
    if (!digits) return false;
    double magnitude = 0.0;
    const auto [after, error] = std::from_chars(p, end, magnitude, std::chars_format::general);
    p = after;
    if (error == std::errc::result_out_of_range) value = from_bits(nan_bits | std::uint64_t(begin - text + 1));
    else if (error != std::errc()) return false;
    else value = negative ? -magnitude : magnitude;
    return true;
}

// Moves `p` from the end of one number to the start of the next; returns false if the separator is wrong.
bool skip_separator(const char*& p, const char* end, char separator)
{
    const char* const begin = p;
    p = skip_blanks(p, end);
    if (!separator) return p > begin;
    if (p >= end || *p != separator) return false;
    p = skip_blanks(p + 1, end);
    return true;
}

char* write_double(double value, char* out)
{
    const double size = std::fabs(value);
    const bool plain = size == 0.0 || (size >= 1e-4 && size < 1e16);
    const auto format = plain ? std::chars_format::fixed : std::chars_format::scientific;
    // The sign of a NaN says nothing.
    char* const end = std::to_chars(out, out + longest_number, std::isnan(value) ? size : value, format).ptr;
    return plain && std::find(out, end, '.') == end ? std::copy_n(".0", 2, end) : end;
}

} // namespace

std::int64_t write_rows(
    const std::uint64_t* table, std::int64_t rows, const char* pattern, std::int64_t pattern_size, char* out)
{
    char* at = out;
    for (std::int64_t row = 0; row < rows; ++row)
        for (const char* p = pattern; p < pattern + pattern_size; ++p)
            if (*p == float64_place) at = write_double(from_bits(*table++), at);
            else if (*p == int64_place) at = std::to_chars(at, at + longest_number, std::int64_t(*table++)).ptr;
            else if (*p == uint64_place) at = std::to_chars(at, at + longest_number, *table++).ptr;
            else *at++ = *p;
    return at - out;
}

std::int64_t count_rows(const Text& text, std::int64_t first, std::int64_t last)
{
    const char* p = text.data + line_start(text, first);
    const char* const end = text.data + line_start(text, last);
    std::int64_t rows = 0;
    while (p < end) {
        while (p < end && (is_blank(*p) || *p == '\r')) ++p;
        if (p >= end) break;
        rows += *p != '\n';
        const void* const found = std::memchr(p, '\n', std::size_t(end - p));
        p = found ? static_cast<const char*>(found) + 1 : end;
    }
    return rows;
}

bool parse_rows(const Text& text, std::int64_t first, std::int64_t last, std::int64_t columns, char separator,
    double* table, std::int64_t size)
{
    const char* p = text.data + line_start(text, first);
    const char* const end = text.data + line_start(text, last);
    std::int64_t at = 0;
    while (p < end) {
        while (p < end && (is_blank(*p) || *p == '\r')) ++p;
        if (p >= end) break;
        if (*p == '\n') {
            ++p;
            continue;
        }
        if (columns > size - at) return false;
        for (std::int64_t column = 0; column < columns; ++column) {
            if (column && !skip_separator(p, end, separator)) return false;
            if (!parse_number(text.data, p, end, table[at++])) return false;
        }
        p = skip_blanks(p, end);
        if (p < end && *p == '\r') ++p;
        if (p < end && *p++ != '\n') return false;
    }
    return at == size;
}

} // namespace geokit
