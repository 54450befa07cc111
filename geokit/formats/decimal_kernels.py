"""Rows of decimal numbers, a chunk of text for each thread: counted, then parsed.

Only plain rows are understood: digits with a sign, a point and an exponent, or ``nan``, between separators. A chunk
with anything else is reported, and the text is then left to a slower reader.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

# One rounding where the text says one: a fused multiply-add has none to offer here, and must not.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Where the lines of a chunk begin: after the first line end at or after its first byte, but for the first chunk.
LINE_START = """
    if (at <= start) return start;
    if (at >= stop) return stop;
    int64_t p = at - 1;
    while (p < stop && text.data[p] != '\\n') ++p;
    return p < stop ? p + 1 : stop;
"""


@wp.func_native(LINE_START)
def line_start(text: wp.array(dtype=wp.uint8), start: wp.int64, stop: wp.int64, at: wp.int64) -> wp.int64: ...


COUNT_LINES = """
    int64_t rows = 0;
    bool filled = false;
    for (int64_t p = begin; p < end; ++p) {
        const uint8_t c = text.data[p];
        if (c == '\\n') {
            rows += filled;
            filled = false;
        } else if (c != ' ' && c != '\\t' && c != '\\r') {
            filled = true;
        }
    }
    return rows + filled;
"""


@wp.func_native(COUNT_LINES)
def count_lines(text: wp.array(dtype=wp.uint8), begin: wp.int64, end: wp.int64) -> wp.int64:
    """Lines in which there is something."""
    ...


# The value of w * 10^q, correctly rounded, or a NaN that tells where its text stands.
#
# Up to 2^53 and 10^22 both factors are exact and one operation rounds once (Clinger, How to read floating point numbers
# accurately, 1990). Otherwise w is multiplied by 128 bits of 10^q, cut off, as in Lemire, Number parsing at a gigabyte
# per second (2021), with a simpler end: the 192-bit product is less than two units of its middle word below the true
# one, so the rounding is known unless half a unit of the result lies between the two. Then, which is rare but for
# exact ties, and for results that are denormal or infinite, the caller is told to read the text by other means.
TO_DOUBLE = """
    const auto to_double = [&](uint64_t w, int q, bool cut, bool negative, int64_t place) -> double {
        const double tens[23] = {1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
                                 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
        union { uint64_t bits; double value; } result;
        result.bits = 0x7ff8000000000000ull | uint64_t(place + 1);
        const uint64_t sign = negative ? 0x8000000000000000ull : 0ull;
        if (w == 0 && !cut) {
            result.bits = sign;
        } else if (!cut && w <= (1ull << 53) && q >= -22 && q <= 22) {
            result.value = q < 0 ? double(w) / tens[-q] : double(w) * tens[q];
            result.bits |= sign;
        } else if (w != 0 && q >= -342 && q <= 308) {
            int zeros = 0;
            for (uint64_t v = w; !(v >> 63); v <<= 1) ++zeros;
            const uint64_t v = w << zeros, high = powers.data[2 * (q + 342)], low = powers.data[2 * (q + 342) + 1];
#if defined(__CUDA_ARCH__)
            uint64_t top = __umul64hi(v, high), middle = v * high;
            const uint64_t carried = __umul64hi(v, low);
#else
            const unsigned __int128 product = (unsigned __int128)v * high;
            uint64_t top = uint64_t(product >> 64), middle = uint64_t(product);
            const uint64_t carried = uint64_t(((unsigned __int128)v * low) >> 64);
#endif
            middle += carried;
            if (middle < carried) ++top;
            const int shift = 10 + int32_t(top >> 63);
            uint64_t m = top >> shift;
            const uint64_t rest = top & ((1ull << shift) - 1), half = 1ull << (shift - 1);
            // Digits that were cut off are worth less than one unit of w, 16 of the top word after the shift.
            const bool unsure = cut ? (rest + 18 >= half && rest <= half)
                                    : ((rest == half && middle == 0) || (rest + 1 == half && middle + 2 < 2));
            if (rest >= half) ++m;
            int exponent = exponents.data[q + 342] + 128 + shift - zeros + 52 + 1023;
            if (m >> 53) {
                m >>= 1;
                ++exponent;
            }
            if (!unsure && exponent >= 1 && exponent <= 2046)
                result.bits = sign | (uint64_t(exponent) << 52) | (m & 0xfffffffffffffull);
        }
        return result.value;
    };
"""

# Nineteen digits always fit into 64 bits; of later ones only the number counts. An exponent of more than six digits is
# out of every range.
PARSE_LINES = """
    const uint8_t* s = text.data;
    const uint8_t separator = uint8_t(separator_code);
    int64_t p = begin, at = row * columns;
    while (p < end) {
        while (p < end && (s[p] == ' ' || s[p] == '\\t' || s[p] == '\\r')) ++p;
        if (p < end && s[p] == '\\n') { ++p; continue; }
        if (p >= end) break;
        for (int column = 0; column < columns; ++column) {
            if (column) {
                bool apart = false;
                while (p < end && (s[p] == ' ' || s[p] == '\\t')) { ++p; apart = true; }
                if (separator) {
                    if (p >= end || s[p] != separator) return 1;
                    ++p;
                    while (p < end && (s[p] == ' ' || s[p] == '\\t')) ++p;
                } else if (!apart) return 1;
            }
            const int64_t place = p;
            bool negative = false;
            if (p < end && (s[p] == '-' || s[p] == '+')) negative = s[p++] == '-';
            uint64_t w = 0;
            int64_t q = 0;
            int digits = 0;
            bool point = false, seen = false, cut = false;
            for (; p < end; ++p) {
                const uint8_t c = s[p];
                if (c == '.' && !point) { point = true; continue; }
                if (c < '0' || c > '9') break;
                seen = true;
                if (digits < 19) {
                    w = 10 * w + (c - '0');
                    digits += w != 0;
                    q -= point;
                } else {
                    cut |= c != '0';
                    q += !point;
                }
            }
            if (!seen) {
                if (point || p + 2 >= end || (s[p] | 32) != 'n' || (s[p + 1] | 32) != 'a' || (s[p + 2] | 32) != 'n')
                    return 1;
                p += 3;
                table.data[at++] = to_double(0, 0, true, false, -1);
                continue;
            }
            if (p < end && (s[p] | 32) == 'e') {
                ++p;
                bool down = false;
                if (p < end && (s[p] == '-' || s[p] == '+')) down = s[p++] == '-';
                int64_t e = 0;
                int length = 0;
                for (; p < end && s[p] >= '0' && s[p] <= '9'; ++p, ++length)
                    if (e < 1000000) e = 10 * e + (s[p] - '0');
                if (!length) return 1;
                q += down ? -e : e;
            }
            const int32_t power = int32_t(q < -9999 ? -9999 : q > 9999 ? 9999 : q);
            table.data[at++] = to_double(w, power, cut, negative, place);
        }
        while (p < end && (s[p] == ' ' || s[p] == '\\t')) ++p;
        if (p < end && s[p] == '\\r') ++p;
        if (p < end && s[p++] != '\\n') return 1;
    }
    return 0;
"""


@wp.func_native(TO_DOUBLE + PARSE_LINES)
def parse_lines(
    text: wp.array(dtype=wp.uint8),
    begin: wp.int64,
    end: wp.int64,
    row: wp.int64,
    columns: wp.int32,
    separator_code: wp.int32,
    powers: wp.array(dtype=wp.uint64),
    exponents: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.float64),
) -> wp.int32:
    """Fills the rows from ``row`` on; 1 where something is not understood."""
    ...


@wp.kernel
def count_kernel(
    first: int,
    text: wp.array(dtype=wp.uint8),
    start: wp.int64,
    stop: wp.int64,
    size: wp.int64,
    out_rows: wp.array(dtype=wp.int64),
):
    """Rows in each chunk of ``size`` bytes."""
    i = first + wp.tid()
    begin = line_start(text, start, stop, start + wp.int64(i) * size)
    end = line_start(text, start, stop, start + wp.int64(i + 1) * size)
    out_rows[i] = count_lines(text, begin, end)


@wp.kernel
def parse_kernel(
    first: int,
    text: wp.array(dtype=wp.uint8),
    start: wp.int64,
    stop: wp.int64,
    size: wp.int64,
    row: wp.array(dtype=wp.int64),
    columns: wp.int32,
    separator: wp.int32,
    powers: wp.array(dtype=wp.uint64),
    exponents: wp.array(dtype=wp.int32),
    out_table: wp.array(dtype=wp.float64),
    out_odd: wp.array(dtype=wp.int32),
):
    """The numbers of each chunk, from its first row on, and whether there is something else in it."""
    i = first + wp.tid()
    begin = line_start(text, start, stop, start + wp.int64(i) * size)
    end = line_start(text, start, stop, start + wp.int64(i + 1) * size)
    out_odd[i] = parse_lines(text, begin, end, row[i], columns, separator, powers, exponents, out_table)
