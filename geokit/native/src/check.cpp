#include "nano_types.h"
#include "pulse.h"

#include <cmath>
#include <cstring>

namespace geokit {
namespace {

// "NanoVDB1": releases from 32.6 on write it before a grid whose layout is the same.
constexpr uint64_t kNewerMagic = 0x314244566f6e614eUL;

[[noreturn]] void damaged(const std::string& what) { throw BridgeError("damaged", "NanoVDB buffer: " + what); }

// The bytes of one grid, with tests whether a node lies inside them.
struct Extent {
    const uint8_t* begin;
    uint64_t size;

    // Offset of the node that lies `distance` bytes from the one at `from`.
    uint64_t node(uint64_t from, int64_t distance, uint64_t node_size, const char* what) const
    {
        // Unsigned arithmetic wraps instead of overflowing; a wrapped offset fails the comparison below.
        const uint64_t at = from + static_cast<uint64_t>(distance);
        if (at > size || size - at < node_size || at % NANOVDB_DATA_ALIGNMENT != 0) {
            damaged(std::string("a ") + what + " lies outside the grid");
        }
        return at;
    }
};

// Loading another byte as a bool is undefined. Other types have no such bytes.
template<typename T>
void check_bool(const T& value)
{
    if constexpr (nanovdb::is_same<T, bool>::value) {
        if (reinterpret_cast<const uint8_t&>(value) > 1) damaged("a tile or the background is neither true nor false");
    }
}

template<typename BuildT>
class TreeCheck {
    using Upper = nanovdb::NanoUpper<BuildT>;
    using Lower = nanovdb::NanoLower<BuildT>;
    using Leaf = nanovdb::NanoLeaf<BuildT>;
    using Root = nanovdb::NanoRoot<BuildT>;

public:
    explicit TreeCheck(Extent extent) : extent_(extent) {}

    void run()
    {
        const uint64_t tree_at = sizeof(nanovdb::GridData);
        const auto* tree = at<nanovdb::TreeData<3>>(tree_at);
        const uint64_t sizes[3]
            = {leaf_header_size(), sizeof(typename Lower::DataType), sizeof(typename Upper::DataType)};
        static const char* const names[3] = {"leaf", "lower node", "upper node"};
        for (int level = 0; level < 3; ++level) {
            const uint64_t count = tree->mNodeCount[level];
            if (count == 0) continue;
            if (count > extent_.size / sizes[level])
                damaged(std::string("more ") + names[level] + "s than fit into it");
            // Readers that traverse a level as an array use only these counts and first-node offsets.
            if (tree->mNodeOffset[level] != 0) {
                const uint64_t span = Leaf::FIXED_SIZE || level > 0 ? count * sizes[level] : sizes[level];
                extent_.node(tree_at, int64_t(tree->mNodeOffset[level]), span, names[level]);
            }
            left_[level] = count;
        }
        check_root(tree_at, *tree);
    }

private:
    template<typename T>
    const T* at(uint64_t offset) const
    { return reinterpret_cast<const T*>(extent_.begin + offset); }

    static constexpr uint64_t leaf_header_size() { return sizeof(typename Leaf::DataType); }

    // A buffer whose offsets all refer to one node would make this traversal endless, so the header's counts bound it.
    void count(int level)
    {
        if (left_[level] == 0) damaged("the tree has more nodes than its header says");
        --left_[level];
    }

    void check_root(uint64_t tree_at, const nanovdb::TreeData<3>& tree)
    {
        using Data = typename Root::DataType;
        const uint64_t root_at = extent_.node(tree_at, int64_t(tree.mNodeOffset[3]), sizeof(Data), "root");
        const auto* root = at<Data>(root_at);
        const uint64_t tile_count = root->mTableSize;
        if (tile_count > (extent_.size - root_at - sizeof(Data)) / sizeof(typename Data::Tile)) {
            damaged("its root table lies outside the grid");
        }
        check_bool(root->mBackground);
        for (uint32_t i = 0; i < tile_count; ++i) {
            if (const int64_t child = root->tile(i)->child) {
                count(2);
                check_upper(extent_.node(root_at, child, sizeof(typename Upper::DataType), "upper node"));
            } else {
                check_bool(root->tile(i)->value);
            }
        }
    }

    template<typename Node>
    static void check_tiles(const Node* node)
    {
        if constexpr (nanovdb::is_same<typename Node::ValueT, bool>::value) {
            for (auto it = node->mChildMask.beginOff(); it; ++it) check_bool(node->mTable[*it].value);
        }
    }

    void check_upper(uint64_t upper_at)
    {
        const auto* upper = at<typename Upper::DataType>(upper_at);
        check_tiles(upper);
        for (auto it = upper->mChildMask.beginOn(); it; ++it) {
            count(1);
            check_lower(
                extent_.node(upper_at, upper->mTable[*it].child, sizeof(typename Lower::DataType), "lower node"));
        }
    }

    void check_lower(uint64_t lower_at)
    {
        pulse_if_any();
        const auto* lower = at<typename Lower::DataType>(lower_at);
        check_tiles(lower);
        for (auto it = lower->mChildMask.beginOn(); it; ++it) {
            count(0);
            const uint64_t leaf_at = extent_.node(lower_at, lower->mTable[*it].child, leaf_header_size(), "leaf");
            if constexpr (nanovdb::is_same<BuildT, nanovdb::FpN>::value) {
                const uint64_t whole = at<typename Leaf::DataType>(leaf_at)->memUsage();
                extent_.node(leaf_at, 0, whole, "leaf");
            }
        }
    }

    Extent extent_;
    uint64_t left_[3] = {0, 0, 0};
};

void check_name(const nanovdb::GridData& grid, const Extent& extent)
{
    using nanovdb::GridBlindMetaData;
    const bool is_long = (grid.mFlags & uint32_t(nanovdb::GridFlags::HasLongGridName)) != 0;
    if (!is_long) {
        if (std::memchr(grid.mGridName, 0, sizeof(grid.mGridName)) == nullptr) damaged("its name does not end");
        return;
    }
    const uint64_t count = grid.mBlindMetadataCount;
    if (count == 0 || count > extent.size / sizeof(GridBlindMetaData)) damaged("its long name is missing");
    const uint64_t first
        = extent.node(0, grid.mBlindMetadataOffset, count * sizeof(GridBlindMetaData), "description of blind data");
    const uint64_t last = first + (count - 1) * sizeof(GridBlindMetaData);
    const auto* blind = reinterpret_cast<const GridBlindMetaData*>(extent.begin + last);
    const uint64_t at = last + uint64_t(blind->mByteOffset);
    if (blind->mDataClass != nanovdb::GridBlindDataClass::GridName || at >= extent.size
        || std::memchr(extent.begin + at, 0, extent.size - at) == nullptr) {
        damaged("its long name lies outside the grid");
    }
}

} // namespace

void check_nanovdb(const uint8_t* data, uint64_t size)
{
    if (size < sizeof(nanovdb::GridData) + sizeof(nanovdb::TreeData<3>)) damaged("shorter than a grid's header");
    if (reinterpret_cast<uintptr_t>(data) % NANOVDB_DATA_ALIGNMENT != 0) {
        throw BridgeError("input", "a NanoVDB buffer must start at a 32-byte boundary; copy it into an aligned array");
    }
    const auto* grid = reinterpret_cast<const nanovdb::GridData*>(data);
    if (grid->mMagic != NANOVDB_MAGIC_NUMBER && grid->mMagic != kNewerMagic) damaged("its magic number is missing");
    if (grid->mVersion.getMajor() != NANOVDB_MAJOR_VERSION_NUMBER) {
        throw BridgeError("unsupported",
            "a NanoVDB buffer of ABI version " + std::to_string(grid->mVersion.getMajor()) + "; this build knows "
                + std::to_string(NANOVDB_MAJOR_VERSION_NUMBER));
    }
    if (grid->mGridCount != 1 || grid->mGridIndex != 0) {
        throw BridgeError("input", "a NanoVDB buffer must hold one grid; split it by grid");
    }
    if (grid->mGridSize > size) damaged("shorter than its header says");
    const auto grid_class = grid->mGridClass;
    if (grid_class == nanovdb::GridClass::PointIndex || grid_class == nanovdb::GridClass::PointData
        || grid_class == nanovdb::GridClass::IndexGrid) {
        throw BridgeError("unsupported", "point and index grids cannot be converted");
    }
    for (double value : grid->mMap.mMatD)
        if (!std::isfinite(value)) damaged("its transform is not finite");
    for (double value : grid->mMap.mVecD)
        if (!std::isfinite(value)) damaged("its transform is not finite");

    const Extent extent{data, grid->mGridSize};
    check_name(*grid, extent);
    dispatch(grid->mGridType, [&](auto tag) { TreeCheck<typename decltype(tag)::Type>(extent).run(); });
}

} // namespace geokit
