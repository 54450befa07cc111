#include "convert.h"
#include "open_grids.h"

#include <nanovdb/util/OpenToNanoVDB.h>

#include <algorithm>
#include <mutex>
#include <set>
#include <type_traits>

// NanoVDB 32.4 lists Vec3d among its types, but its converter omits it from the list of headers and throws. This adds
// that one step for Vec3d.
namespace nanovdb {

template<>
inline NanoGrid<Vec3d>* OpenToNanoVDB<openvdb::Vec3d, Vec3d, AbsDiff, geokit::MappedBuffer>::processGrid(
    const OpenGridT& source)
{
    auto* grid = reinterpret_cast<NanoGridT*>(mBufferPtr + mBufferOffsets[0]);
    GridData& data = *grid->data();
    data.mMagic = NANOVDB_MAGIC_NUMBER;
    data.mVersion = Version();
    data.mFlags = uint32_t(GridFlags::IsBreadthFirst);
    data.mGridCount = 1;
    data.mGridSize = mBufferOffsets[8];
    const std::string name = source.getName();
    std::strncpy(data.mGridName, name.c_str(), GridData::MaxNameSize - 1);
    if (name.length() >= GridData::MaxNameSize) data.setLongGridNameOn();
    data.mWorldBBox = BBox<Vec3R>();
    data.mGridType = GridType::Vec3d;
    data.mGridClass = GridClass::Unknown;
    if (source.getGridClass() == openvdb::GRID_FOG_VOLUME) data.mGridClass = GridClass::FogVolume;
    if (source.getGridClass() == openvdb::GRID_STAGGERED) data.mGridClass = GridClass::Staggered;
    const auto affine = source.transform().baseMap()->getAffineMap();
    data.mVoxelSize = affine->voxelSize();
    data.mMap.set(affine->getMat4(), affine->getMat4().inverse(), 1.0);
    this->processTree(source.tree());
    if (!mBlindMetaData.empty()) {
        auto* blind = this->processMetadata(source);
        data.mBlindMetadataOffset = PtrDiff(blind, grid);
        data.mBlindMetadataCount = uint32_t(mBlindMetaData.size());
    }
    return grid;
}

} // namespace nanovdb

namespace geokit {
namespace {

// Whether NanoVDB's converter accepts the class of this grid.
bool keeps_class(const openvdb::GridBase& grid)
{
    const auto grid_class = grid.getGridClass();
    if (grid.isType<openvdb::MaskGrid>()) return grid_class == openvdb::GRID_UNKNOWN;
    const bool is_real = grid.isType<openvdb::FloatGrid>() || grid.isType<openvdb::DoubleGrid>();
    return is_real || grid_class != openvdb::GRID_LEVEL_SET;
}

template<typename GridT>
MappedBuffer convert(const GridT& grid, const Affine& affine, const MappedBuffer& context)
{
    using OpenBuildT = typename GridT::TreeType::BuildType;
    using NanoBuildT = typename nanovdb::OpenToNanoType<OpenBuildT>::Type;
    nanovdb::OpenToNanoVDB<OpenBuildT, NanoBuildT, nanovdb::AbsDiff, MappedBuffer> converter;
    // The checksum is written last, after the header's doubles have been set bit for bit.
    auto handle = converter(grid, nanovdb::StatsMode::Default, nanovdb::ChecksumMode::Disable, 0, context);
    auto* nano = handle.template grid<NanoBuildT>();
    if (nano == nullptr) throw BridgeError("unsupported", "NanoVDB's converter gave no grid of the expected type");
    store(affine, reinterpret_cast<nanovdb::GridData*>(nano)->mMap);
    nanovdb::updateChecksum(*nano, nanovdb::ChecksumMode::Default);
    return std::move(handle.buffer());
}

} // namespace

void initialize()
{
    static std::once_flag once;
    std::call_once(once, [] {
        openvdb::initialize();
        register_extra_grids();
    });
}

bool is_convertible(const std::string& grid_type)
{
    static const std::set<std::string> types = {openvdb::FloatGrid::gridType(), openvdb::DoubleGrid::gridType(),
        openvdb::Int32Grid::gridType(), openvdb::Int64Grid::gridType(), UInt32Grid::gridType(),
        openvdb::Vec3SGrid::gridType(), openvdb::Vec3DGrid::gridType(), openvdb::Vec3IGrid::gridType(),
        openvdb::BoolGrid::gridType(), openvdb::MaskGrid::gridType(), Vec4fGrid::gridType(), Vec4dGrid::gridType()};
    return types.count(grid_type) == 1;
}

bool holds_points(const std::string& grid_type) { return grid_type == "Tree_ptdataidx32_5_4_3"; }

bool is_plausible_type(const std::string& grid_type)
{
    static const std::set<std::string> value_types = {"bool", "mask", "half", "float", "double", "int16", "int32",
        "int64", "uint8", "uint16", "uint32", "uint64", "string", "vec2s", "vec2d", "vec2i", "vec2ui", "vec3s", "vec3d",
        "vec3i", "vec3ui", "vec4s", "vec4d", "vec4i", "quats", "quatd", "mat3s", "mat3d", "mat4s", "mat4d", "ptidx32",
        "ptidx64", "ptdataidx32", "ptdataidx64"};
    const std::string prefix = "Tree_";
    if (grid_type.compare(0, prefix.size(), prefix) != 0) return false;
    const size_t end = grid_type.find('_', prefix.size());
    if (end == std::string::npos) return false;
    const std::string levels = grid_type.substr(end);
    return value_types.count(grid_type.substr(prefix.size(), end - prefix.size())) == 1
        && levels.find_first_not_of("_0123456789") == std::string::npos;
}

openvdb::GridClass class_after_round_trip(const openvdb::GridBase& grid)
{ return keeps_class(grid) ? grid.getGridClass() : openvdb::GRID_UNKNOWN; }

MappedBuffer to_nanovdb(const openvdb::GridBase::Ptr& base, const std::string& path)
{
    const auto context = MappedBuffer::in_file(path);
    // Read before the grid is copied, because copying rounds it. Rejects frustums.
    const Affine affine = affine_of(base->transform());
    openvdb::GridBase::Ptr grid = base;
    if (const auto integers = openvdb::gridPtrCast<openvdb::Vec3IGrid>(base)) {
        const auto doubles = to_vec3d(*integers);
        doubles->setTransform(integers->transformPtr());
        grid = doubles;
    }
    if (!keeps_class(*grid)) {
        // NanoVDB throws at level sets whose values are not real numbers.
        grid = grid->copyGrid();
        grid->setGridClass(openvdb::GRID_UNKNOWN);
    }
    MappedBuffer result;
    const bool done = grid->apply<DirectGrids>([&](const auto& typed) { result = convert(typed, affine, context); });
    if (!done) throw BridgeError("unsupported", "a grid of type " + grid->type() + " has no NanoVDB counterpart");
    return result;
}

} // namespace geokit
