#include "bridge.h"

#include "json.h"
#include "read.h"

#include <nanovdb/NanoVDB.h>
#include <openvdb/version.h>
#include <tbb/version.h>

namespace geokit {
namespace {

std::string dotted(int major, int minor, int patch)
{ return std::to_string(major) + "." + std::to_string(minor) + "." + std::to_string(patch); }

} // namespace

std::string read_vdb(const std::string& path, const std::vector<std::string>& names, std::vector<MappedBuffer>& buffers)
{
    VdbFile file(path);
    auto grids = file.read(names);
    const auto json = to_json(grids, file.metadata());
    for (auto& grid : grids) buffers.push_back(std::move(grid.buffer));
    return json;
}

std::string inspect_vdb(const std::string& path)
{
    VdbFile file(path);
    return to_json(file.inspect(), file.metadata());
}

std::string spool_vdb(
    const std::string& path, const std::vector<std::string>& names, const std::string& spool, uint64_t spool_limit)
{
    VdbFile file(path);
    return to_json(file.read(names, spool, spool_limit), file.metadata());
}

std::string openvdb_version()
{
    return dotted(OPENVDB_LIBRARY_MAJOR_VERSION_NUMBER, OPENVDB_LIBRARY_MINOR_VERSION_NUMBER,
        OPENVDB_LIBRARY_PATCH_VERSION_NUMBER);
}

std::string nanovdb_version()
{ return dotted(NANOVDB_MAJOR_VERSION_NUMBER, NANOVDB_MINOR_VERSION_NUMBER, NANOVDB_PATCH_VERSION_NUMBER); }

std::vector<std::pair<std::string, std::string>> build_facts()
{
#ifdef __clang__
    const std::string compiler = "Clang ";
#else
    const std::string compiler = "GCC ";
#endif
    return {{"tbb", TBB_runtime_version()}, {"compiler", compiler + __VERSION__}};
}

} // namespace geokit
