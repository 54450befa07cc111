#include "lzf.h"

#include <algorithm>
#include <cstring>
#include <vector>

namespace geokit {

namespace {

constexpr std::int64_t literal_run = 32;
constexpr std::int64_t longest_match = 264;
// Most back references are no longer than this.
constexpr std::int64_t short_match = 16;
constexpr std::int64_t largest_distance = 8192;
// Size of the hash table, which stores positions by the hash of the three bytes there.
constexpr int table_bits = 15;

std::uint32_t slot_of(const std::uint8_t* bytes)
{
    const std::uint32_t three = (std::uint32_t(bytes[0]) << 16) | (std::uint32_t(bytes[1]) << 8) | bytes[2];
    return (three * 2654435761u) >> (32 - table_bits);
}

// Number of bytes that two positions have in common, up to a limit; 0 if fewer than three.
std::int64_t match_length(const std::uint8_t* a, const std::uint8_t* b, std::int64_t most)
{
    if (a[0] != b[0] || a[1] != b[1] || a[2] != b[2]) return 0;
    std::int64_t length = 3;
    while (length + 8 <= most && std::memcmp(a + length, b + length, 8) == 0) length += 8;
    while (length < most && a[length] == b[length]) ++length;
    return length;
}

} // namespace

std::int64_t lzf_decompress(const std::uint8_t* packed, std::int64_t packed_size, std::uint8_t* out, std::int64_t size)
{
    std::int64_t in = 0, to = 0, at = 0;
    while (in < packed_size) {
        at = in;
        const std::int64_t control = packed[in++];
        if (control < literal_run) {
            const std::int64_t run = control + 1;
            if (run > packed_size - in || run > size - to) return at;
            // A copy of constant size is several times as fast. Surplus bytes are overwritten later or rejected.
            if (packed_size - in >= literal_run && size - to >= literal_run)
                std::memcpy(out + to, packed + in, literal_run);
            else std::memcpy(out + to, packed + in, std::size_t(run));
            in += run;
            to += run;
            continue;
        }
        std::int64_t length = control >> 5;
        if (packed_size - in < (length == 7 ? 2 : 1)) return at;
        if (length == 7) length += packed[in++];
        length += 2;
        const std::int64_t distance = (((control & 31) << 8) | packed[in++]) + 1;
        if (distance > to || length > size - to) return at;
        if (distance >= short_match && length <= short_match && size - to >= short_match) {
            std::memcpy(out + to, out + to - distance, short_match);
            to += length;
        } else if (distance >= length) {
            std::memcpy(out + to, out + to - distance, std::size_t(length));
            to += length;
        } else {
            // The reference overlaps its own output: the bytes repeat, and each copy doubles the known part.
            const std::int64_t begin = to - distance;
            while (length > 0) {
                const std::int64_t known = std::min(length, to - begin);
                std::memcpy(out + to, out + begin, std::size_t(known));
                to += known;
                length -= known;
            }
        }
    }
    return to == size ? -1 : at;
}

std::int64_t lzf_compress(const std::uint8_t* plain, std::int64_t size, std::uint8_t* out)
{
    std::vector<std::int64_t> table(std::size_t(1) << table_bits, -1);
    // While a run of literals is open, out[to - literals - 1] is its control byte.
    std::int64_t at = 0, to = 0, literals = 0;
    while (at < size) {
        std::int64_t length = 0, distance = 0;
        if (at + 2 < size) {
            std::int64_t& slot = table[slot_of(plain + at)];
            const std::int64_t seen = slot;
            slot = at;
            distance = at - seen;
            if (seen >= 0 && distance <= largest_distance)
                length = match_length(plain + seen, plain + at, std::min(size - at, longest_match));
        }
        if (length) {
            if (literals) out[to - literals - 1] = std::uint8_t(literals - 1);
            literals = 0;
            const std::int64_t code = length - 2, back = distance - 1;
            out[to++] = std::uint8_t((std::min<std::int64_t>(code, 7) << 5) | (back >> 8));
            if (code >= 7) out[to++] = std::uint8_t(code - 7);
            out[to++] = std::uint8_t(back & 255);
            at += length;
        } else {
            if (literals == 0) ++to;
            out[to++] = plain[at++];
            if (++literals == literal_run) {
                out[to - literals - 1] = std::uint8_t(literals - 1);
                literals = 0;
            }
        }
    }
    if (literals) out[to - literals - 1] = std::uint8_t(literals - 1);
    return to;
}

} // namespace geokit
