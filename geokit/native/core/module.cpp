// The extension `geokit.native._core`: text and LZF of files, with nothing but a compiler. Every function checks its sizes
// and releases the GIL while it works.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <stdexcept>

#include "decimal.h"
#include "lzf.h"

namespace nb = nanobind;

namespace {

using Bytes = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using OutBytes = nb::ndarray<std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const std::uint64_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutDoubles = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

geokit::Text checked(const nb::bytes& data, std::int64_t start, std::int64_t stop)
{
    if (start < 0 || start > stop || stop > std::int64_t(data.size()))
        throw std::invalid_argument("start and stop are not a range of the text");
    return {data.c_str(), start, stop};
}

std::int64_t count_rows(
    const nb::bytes& data, std::int64_t start, std::int64_t stop, std::int64_t first, std::int64_t last)
{
    const geokit::Text text = checked(data, start, stop);
    nb::gil_scoped_release released;
    return geokit::count_rows(text, first, last);
}

bool parse_rows(const nb::bytes& data, std::int64_t start, std::int64_t stop, std::int64_t first, std::int64_t last,
    std::int64_t columns, int separator, OutDoubles table)
{
    const geokit::Text text = checked(data, start, stop);
    if (columns < 1) throw std::invalid_argument("columns is less than one");
    double* const numbers = table.data();
    const std::int64_t size = std::int64_t(table.size());
    nb::gil_scoped_release released;
    return geokit::parse_rows(text, first, last, columns, char(separator), numbers, size);
}

std::int64_t write_rows(Rows table, const nb::bytes& pattern, OutBytes out)
{
    const char* const row = pattern.c_str();
    const std::int64_t size = std::int64_t(pattern.size()), rows = std::int64_t(table.shape(0));
    const auto count = std::count_if(row, row + size, [](unsigned char sign) { return sign < geokit::places; });
    if (std::size_t(count) != table.shape(1)
        || std::int64_t(out.size()) < rows * (size + count * geokit::longest_number))
        throw std::invalid_argument("pattern has not a place for each column, or out is too small for the worst case");
    const std::uint64_t* const numbers = table.data();
    char* const to = reinterpret_cast<char*>(out.data());
    nb::gil_scoped_release released;
    return geokit::write_rows(numbers, rows, row, size, to);
}

std::int64_t lzf_decompress(Bytes packed, OutBytes out)
{
    const std::uint8_t* const from = packed.data();
    std::uint8_t* const to = out.data();
    const std::int64_t packed_size = std::int64_t(packed.size()), size = std::int64_t(out.size());
    nb::gil_scoped_release released;
    return geokit::lzf_decompress(from, packed_size, to, size);
}

std::int64_t lzf_compress(Bytes plain, OutBytes out)
{
    const std::int64_t size = std::int64_t(plain.size());
    if (std::int64_t(out.size()) < geokit::lzf_bound(size))
        throw std::invalid_argument("out is too small for the worst case");
    const std::uint8_t* const from = plain.data();
    std::uint8_t* const to = out.data();
    nb::gil_scoped_release released;
    return geokit::lzf_compress(from, size, to);
}

} // namespace

NB_MODULE(_core, m)
{
    m.def("count_rows", &count_rows, nb::arg("text"), nb::arg("start"), nb::arg("stop"), nb::arg("first"),
        nb::arg("last"));
    m.def("parse_rows", &parse_rows, nb::arg("text"), nb::arg("start"), nb::arg("stop"), nb::arg("first"),
        nb::arg("last"), nb::arg("columns"), nb::arg("separator"), nb::arg("table").noconvert());
    m.def("write_rows", &write_rows, nb::arg("table").noconvert(), nb::arg("pattern"), nb::arg("out").noconvert());
    m.def("lzf_decompress", &lzf_decompress, nb::arg("packed").noconvert(), nb::arg("out").noconvert());
    m.def("lzf_compress", &lzf_compress, nb::arg("plain").noconvert(), nb::arg("out").noconvert());
}
