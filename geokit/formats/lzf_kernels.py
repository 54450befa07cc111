"""LZF on one thread of the CPU: what a byte means depends on all before it.

A control byte below 32 announces that many literals and one more. Any other one is a back reference: its upper three
bits are the length less two (7: the next byte is added), its lower five and the next byte the distance less one.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

wp.set_module_options({"enable_backward": False})

# Every read and write is checked: the bytes may be anybody's. Positions are 64-bit, because warp's arrays of bytes
# can be longer than 2^31 and its own indexing is slower than this.
DECOMPRESS = """
    const uint8_t* in = packed.data;
    uint8_t* to = out.data;
    int64_t i = 0, o = 0, at = 0;
    bool sound = true;
    while (sound && i < packed_size) {
        at = i;
        const int64_t control = in[i++];
        if (control < 32) {
            const int64_t run = control + 1;
            sound = run <= packed_size - i && run <= size - o;
            if (sound) {
                for (int64_t k = 0; k < run; ++k) to[o + k] = in[i + k];
                i += run;
                o += run;
            }
        } else {
            int64_t length = control >> 5;
            sound = i + (length == 7 ? 2 : 1) <= packed_size;
            if (sound) {
                if (length == 7) length += in[i++];
                length += 2;
                const int64_t distance = (((control & 31) << 8) | int64_t(in[i++])) + 1;
                sound = distance <= o && length <= size - o;
                // Byte by byte: a reference may reach into what it writes.
                if (sound) for (int64_t k = 0; k < length; ++k, ++o) to[o] = to[o - distance];
            }
        }
    }
    return (sound && o == size) ? int64_t(-1) : at;
"""


@wp.func_native(DECOMPRESS)
def decompress(
    packed: wp.array(dtype=wp.uint8), packed_size: wp.int64, size: wp.int64, out: wp.array(dtype=wp.uint8)
) -> wp.int64: ...


COMPRESS = """
    const uint8_t* in = plain.data;
    uint8_t* to = out.data;
    int64_t i = 0, o = 0, literals = 0;
    // While a run of literals is open, to[o - literals - 1] is its control byte.
    while (i < size) {
        int64_t length = 0, distance = 0;
        if (i + 2 < size) {
            const uint32_t three = (uint32_t(in[i]) << 16) | (uint32_t(in[i + 1]) << 8) | uint32_t(in[i + 2]);
            const uint32_t slot = (three * 2654435761u) >> (32 - table_bits);
            const int64_t seen = table.data[slot];
            table.data[slot] = i;
            distance = i - seen;
            if (seen >= 0 && distance <= 8192
                && in[seen] == in[i] && in[seen + 1] == in[i + 1] && in[seen + 2] == in[i + 2]) {
                const int64_t longest = size - i < 264 ? size - i : 264;
                length = 3;
                while (length < longest && in[seen + length] == in[i + length]) ++length;
            }
        }
        if (length) {
            if (literals) to[o - literals - 1] = uint8_t(literals - 1);
            literals = 0;
            const int64_t code = length - 2, back = distance - 1;
            to[o++] = uint8_t(((code < 7 ? code : 7) << 5) | (back >> 8));
            if (code >= 7) to[o++] = uint8_t(code - 7);
            to[o++] = uint8_t(back & 255);
            i += length;
        } else {
            if (literals == 0) ++o;
            to[o++] = in[i++];
            if (++literals == 32) {
                to[o - 33] = 31;
                literals = 0;
            }
        }
    }
    if (literals) to[o - literals - 1] = uint8_t(literals - 1);
    return o;
"""


@wp.func_native(COMPRESS)
def compress(
    plain: wp.array(dtype=wp.uint8),
    size: wp.int64,
    table: wp.array(dtype=wp.int64),
    table_bits: wp.int32,
    out: wp.array(dtype=wp.uint8),
) -> wp.int64: ...


@wp.kernel
def decompress_kernel(
    first: int,
    packed: wp.array(dtype=wp.uint8),
    packed_size: wp.int64,
    size: wp.int64,
    out: wp.array(dtype=wp.uint8),
    out_bad: wp.array(dtype=wp.int64),
):
    """The plain bytes, and where the packed ones are damaged; one thread."""
    out_bad[first + wp.tid()] = decompress(packed, packed_size, size, out)


@wp.kernel
def compress_kernel(
    first: int,
    plain: wp.array(dtype=wp.uint8),
    size: wp.int64,
    table: wp.array(dtype=wp.int64),
    table_bits: wp.int32,
    out: wp.array(dtype=wp.uint8),
    out_size: wp.array(dtype=wp.int64),
):
    """The packed bytes and their number; one thread."""
    out_size[first + wp.tid()] = compress(plain, size, table, table_bits, out)
