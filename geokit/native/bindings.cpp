// The Python interface of the bridge: arrays in, arrays out. Only geokit/native/_openvdb.py and its workers import it.

#include "operations.h"
#include "points.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <atomic>
#include <chrono>
#include <new>
#include <thread>
#include <tuple>

namespace nb = nanobind;

namespace {

using Bytes = nb::ndarray<nb::numpy, uint8_t, nb::ndim<1>>;
using ConstBytes = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Triangles = nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Corners = nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Starts = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Voxels = nb::ndarray<const uint16_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Places = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Item = std::tuple<std::string, std::string, nb::bytes>; // name, OpenVDB type, value

// One array that owns its memory.
Bytes to_array(geokit::MappedBuffer&& buffer)
{
    auto* owned = new geokit::MappedBuffer(std::move(buffer));
    nb::capsule owner(owned, [](void* pointer) noexcept { delete static_cast<geokit::MappedBuffer*>(pointer); });
    return Bytes(owned->data(), {owned->size()}, owner);
}

nb::ndarray<nb::numpy, double, nb::ndim<1>> to_array(std::vector<double>&& values)
{
    auto* owned = new std::vector<double>(std::move(values));
    nb::capsule owner(owned, [](void* pointer) noexcept { delete static_cast<std::vector<double>*>(pointer); });
    return nb::ndarray<nb::numpy, double, nb::ndim<1>>(owned->data(), {owned->size()}, owner);
}

template<typename T, size_t N>
nb::ndarray<nb::numpy, T, nb::shape<-1, N>> to_array(std::vector<std::array<T, N>>&& rows)
{
    auto* owned = new std::vector<std::array<T, N>>(std::move(rows));
    nb::capsule owner(
        owned, [](void* pointer) noexcept { delete static_cast<std::vector<std::array<T, N>>*>(pointer); });
    return nb::ndarray<nb::numpy, T, nb::shape<-1, N>>(owned->data(), {owned->size(), N}, owner);
}

// OpenVDB's own exceptions concern arguments; all others pass through.
template<typename Op>
auto translated(Op&& op)
{
    try {
        return op();
    } catch (const geokit::BridgeError&) {
        throw;
    } catch (const std::bad_alloc&) {
        throw;
    } catch (const std::exception& error) {
        throw geokit::BridgeError("input", error.what());
    }
}

// Thrown where a signal handler of Python has raised; its error is set in the thread that called. No std::exception, so
// that nothing on the way takes it for an error of OpenVDB.
struct Interrupted {};

// The pulse of an operation: Ctrl-C ends it. Only the thread that called may run Python's handlers, and it takes part
// in all of OpenVDB's loops.
class SignalCheck {
public:
    void operator()()
    {
        if (raised_) throw Interrupted();
        if (std::this_thread::get_id() != caller_) return;
        const auto now = std::chrono::steady_clock::now();
        if (now - last_ < std::chrono::milliseconds(50)) return;
        last_ = now;
        const nb::gil_scoped_acquire acquire;
        if (PyErr_CheckSignals() == 0) return;
        raised_ = true;
        throw Interrupted();
    }

private:
    const std::thread::id caller_ = std::this_thread::get_id();
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
    std::atomic<bool> raised_{false};
};

// Runs what may throw Interrupted, without the interpreter's lock.
template<typename Op>
auto interruptible(Op&& op)
{
    SignalCheck check;
    const geokit::Pulse pulse = std::ref(check);
    const geokit::PulseScope scope(&pulse);
    try {
        nb::gil_scoped_release release;
        return op(pulse);
    } catch (const Interrupted&) {
        throw nb::python_error();
    }
}

auto read_grids(nb::bytes path, const std::vector<std::string>& names)
{
    const std::string source(path.c_str(), path.size());
    std::vector<geokit::MappedBuffer> buffers;
    std::string json;
    interruptible([&](const geokit::Pulse&) { json = geokit::read_vdb(source, names, buffers); });
    std::vector<Bytes> arrays;
    for (auto& buffer : buffers) arrays.push_back(to_array(std::move(buffer)));
    // Bytes, not str: names in the file need not be UTF-8.
    return std::make_pair(nb::bytes(json.data(), json.size()), std::move(arrays));
}

void check_buffer(ConstBytes buffer)
{
    interruptible([&](const geokit::Pulse&) { geokit::check_nanovdb(buffer.data(), buffer.size()); });
}

std::vector<geokit::MetadataItem> to_items(const std::vector<Item>& items)
{
    std::vector<geokit::MetadataItem> made;
    for (const auto& [name, type, value] : items) {
        made.push_back({name, type, std::string(value.c_str(), value.size())});
    }
    return made;
}

void write_grids(nb::bytes path, const std::vector<std::pair<ConstBytes, std::vector<Item>>>& grids,
    const std::vector<Item>& metadata, const std::string& compression, bool half)
{
    std::vector<geokit::WriteGrid> sources;
    for (const auto& [buffer, items] : grids) sources.push_back({buffer.data(), to_items(items)});
    const auto of_file = to_items(metadata);
    const std::string target(path.c_str(), path.size());
    interruptible([&](const geokit::Pulse&) {
        for (size_t i = 0; i < grids.size(); ++i) geokit::check_nanovdb(grids[i].first.data(), grids[i].first.size());
        geokit::write_vdb(target, sources, of_file, compression, half);
    });
}

Bytes to_array(std::string&& text)
{
    auto* owned = new std::string(std::move(text));
    nb::capsule owner(owned, [](void* pointer) noexcept { delete static_cast<std::string*>(pointer); });
    return Bytes(reinterpret_cast<uint8_t*>(owned->data()), {owned->size()}, owner);
}

nb::bytes to_bytes(const std::string& text) { return nb::bytes(text.data(), text.size()); }

auto read_points(nb::bytes path, nb::bytes name)
{
    geokit::PointTable table;
    const std::string source(path.c_str(), path.size()), grid(name.c_str(), name.size());
    interruptible([&](const geokit::Pulse&) { table = geokit::read_points(source, grid); });
    std::vector<std::tuple<nb::bytes, std::string, uint64_t, Bytes>> columns;
    for (auto& column : table.columns) {
        columns.emplace_back(to_bytes(column.name), column.type, column.width, to_array(std::move(column.bytes)));
    }
    std::vector<nb::bytes> left_out;
    for (const auto& one : table.left_out) left_out.push_back(to_bytes(one));
    return std::make_tuple(
        to_array(std::move(table.positions)), std::move(columns), std::move(left_out), to_bytes(table.note));
}

void write_points(nb::bytes path, nb::bytes name, double voxel_size, const std::array<double, 3>& origin,
    Corners corners, Starts starts, Voxels voxels, Places places,
    const std::vector<std::tuple<nb::bytes, std::string, uint64_t, ConstBytes>>& columns, nb::bytes note,
    const std::string& compression)
{
    geokit::PointLeaves points{std::string(name.c_str(), name.size()), voxel_size, {origin[0], origin[1], origin[2]},
        corners.shape(0), corners.data(), starts.data(), voxels.data(), places.data(), {}, {},
        std::string(note.c_str(), note.size())};
    for (const auto& [label, type, width, bytes] : columns) {
        points.columns.push_back({std::string(label.c_str(), label.size()), type, width, ""});
        points.bytes.push_back(bytes.data());
    }
    const std::string target(path.c_str(), path.size());
    interruptible([&](const geokit::Pulse&) { geokit::write_points(target, points, compression); });
}

auto volume_to_mesh(ConstBytes buffer, double isovalue, double adaptivity)
{
    auto mesh = interruptible([&](const geokit::Pulse& pulse) {
        geokit::check_nanovdb(buffer.data(), buffer.size());
        return geokit::volume_to_mesh(buffer.data(), isovalue, adaptivity, pulse);
    });
    return std::make_tuple(
        to_array(std::move(mesh.points)), to_array(std::move(mesh.triangles)), to_array(std::move(mesh.quads)));
}

Bytes mesh_to_level_set(Points points, Triangles triangles, double voxel_size, double half_width)
{
    return to_array(interruptible([&](const geokit::Pulse& pulse) {
        return geokit::mesh_to_level_set(
            points.data(), points.shape(0), triangles.data(), triangles.shape(0), voxel_size, half_width, pulse);
    }));
}

// Runs an operation that takes one or two checked buffers and returns one.
template<typename Op>
Bytes operate(ConstBytes a, Op&& op)
{
    return to_array(interruptible([&](const geokit::Pulse& pulse) {
        geokit::check_nanovdb(a.data(), a.size());
        return translated([&] { return op(a.data(), pulse); });
    }));
}

template<typename Op>
Bytes operate(ConstBytes a, ConstBytes b, Op&& op)
{
    return operate(a, [&](const uint8_t* first, const geokit::Pulse& pulse) {
        geokit::check_nanovdb(b.data(), b.size());
        return op(first, b.data(), pulse);
    });
}

Bytes csg(ConstBytes a, ConstBytes b, const std::string& kind)
{
    return operate(
        a, b, [&](auto* first, auto* second, const auto& pulse) { return geokit::csg(first, second, kind, pulse); });
}

Bytes smooth_csg(ConstBytes a, ConstBytes b, const std::string& kind, double blend)
{
    return operate(a, b, [&](auto* first, auto* second, const auto& pulse) {
        return geokit::smooth_csg(first, second, kind, blend, pulse);
    });
}

Bytes smooth(ConstBytes buffer, const std::string& method, int width, int iterations, double voxel_size)
{
    return operate(buffer, [&](auto* data, const auto& pulse) {
        return geokit::smooth(data, method, width, iterations, voxel_size, pulse);
    });
}

std::pair<double, double> measure(ConstBytes buffer, double voxel_size)
{
    return interruptible([&](const geokit::Pulse& pulse) {
        geokit::check_nanovdb(buffer.data(), buffer.size());
        return translated([&] { return geokit::measure(buffer.data(), voxel_size, pulse); });
    });
}

} // namespace

NB_MODULE(_bridge, module)
{
    // Raised with one argument: the JSON of to_json(), from which __init__.py builds geokit's own exceptions.
    static nb::object bridge_error = nb::exception<geokit::BridgeError>(module, "BridgeError");
    nb::register_exception_translator([](const std::exception_ptr& pointer, void*) {
        try {
            std::rethrow_exception(pointer);
        } catch (const geokit::BridgeError& error) {
            const std::string json = geokit::to_json(error);
            PyErr_SetObject(bridge_error.ptr(), nb::bytes(json.data(), json.size()).ptr());
        }
    });

    module.def("versions", [] { return std::make_pair(geokit::openvdb_version(), geokit::nanovdb_version()); });
    module.def("build_facts", &geokit::build_facts);
    module.def("read", &read_grids, nb::arg("path"), nb::arg("names"));
    module.def("check", &check_buffer, nb::arg("buffer").noconvert());
    module.def("write", &write_grids, nb::arg("path"), nb::arg("grids"), nb::arg("metadata"), nb::arg("compression"),
        nb::arg("half"));
    module.def("read_points", &read_points, nb::arg("path"), nb::arg("name"));
    module.def("write_points", &write_points);
    module.def(
        "volume_to_mesh", &volume_to_mesh, nb::arg("buffer").noconvert(), nb::arg("isovalue"), nb::arg("adaptivity"));
    module.def("mesh_to_level_set", &mesh_to_level_set, nb::arg("points").noconvert(), nb::arg("triangles").noconvert(),
        nb::arg("voxel_size"), nb::arg("half_width"));
    module.def("csg", &csg, nb::arg("a").noconvert(), nb::arg("b").noconvert(), nb::arg("kind"));
    module.def("smooth_csg", &smooth_csg, nb::arg("a").noconvert(), nb::arg("b").noconvert(), nb::arg("kind"),
        nb::arg("blend"));
    module.def("smooth", &smooth, nb::arg("buffer").noconvert(), nb::arg("method"), nb::arg("width"),
        nb::arg("iterations"), nb::arg("voxel_size"));
    module.def("measure", &measure, nb::arg("buffer").noconvert(), nb::arg("voxel_size"));
}
