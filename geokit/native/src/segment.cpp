// Connected components. Level sets are split by their inside, so that a hollow body stays one. (OpenVDB's segmentSDF
// splits surfaces: it returns the wall of a cavity separately, with a negative background.)
#include "level_set.h"
#include "open_grids.h"
#include "operations.h"
#include "redistance.h"

#include <openvdb/tools/LevelSetUtil.h>
#include <openvdb/tools/Morphology.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <atomic>

namespace geokit {
namespace {

using SegmentGrids = openvdb::TypeList<openvdb::FloatGrid, openvdb::DoubleGrid, openvdb::Int32Grid, openvdb::Int64Grid,
    openvdb::Vec3SGrid, openvdb::Vec3DGrid, openvdb::BoolGrid, openvdb::MaskGrid>;

// Bytes per 512 voxels: a leaf of a mask, and its share of the inner nodes.
constexpr double kBytesPerMaskVoxel = 0.25;
// Largest difference [voxels] from the distance to a single body that still counts as equal: several times the error of
// redistancing on smooth surfaces.
constexpr double kSameDistance = 0.1;

template<typename TreeT>
class Parts {
public:
    using ValueT = typename TreeT::ValueType;
    using GridT = openvdb::Grid<TreeT>;

    Parts(const TreeT& tree, double voxel_size)
        : tree_(tree), background_(tree.background()), voxel_size_(voxel_size),
          layers_(int(std::ceil(double(tree.background()) / voxel_size)) + 1)
    {}

    // The body whose inside is `inside`, without the others.
    typename TreeT::Ptr part(const openvdb::BoolTree& inside) const
    {
        openvdb::BoolTree region(inside);
        openvdb::tools::dilateActiveValues(
            region, layers_, openvdb::tools::NN_FACE_EDGE_VERTEX, openvdb::tools::PRESERVE_TILES);
        // Deep inside tiles are enough, but where the field has a leaf the band may reach.
        for (auto leaf = tree_.cbeginLeaf(); leaf; ++leaf) {
            if (region.isValueOn(leaf->origin())) region.touchLeaf(leaf->origin());
        }
        const auto result = std::make_shared<TreeT>(region, background_, -background_, openvdb::TopologyCopy());
        const bool is_alone = copy_values(*result, inside);
        if (!is_alone) separate(*result, inside);
        auto it = result->beginValueOn(); // tiles: all of them deep inside
        it.setMaxDepth(it.getLeafDepth() - 1);
        for (; it; ++it) it.setValueOff();
        openvdb::tools::pruneLevelSet(*result);
        return result;
    }

private:
    // Returns whether no other body is near.
    bool copy_values(TreeT& result, const openvdb::BoolTree& inside) const
    {
        std::atomic<bool> is_alone{true};
        openvdb::tree::LeafManager<TreeT> leaves(result);
        leaves.foreach([&](auto& leaf, size_t) {
            openvdb::tree::ValueAccessor<const TreeT> field(tree_);
            openvdb::tree::ValueAccessor<const openvdb::BoolTree> own(inside);
            for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
                const auto voxel = leaf.offsetToGlobalCoord(n);
                if (!leaf.isValueOn(n)) {
                    leaf.setValueOnly(n, background_);
                    continue;
                }
                const ValueT value = field.getValue(voxel);
                const bool is_other = value < ValueT(0) && !own.isValueOn(voxel);
                if (is_other) is_alone = false;
                leaf.setValueOnly(n, is_other ? background_ : value);
                leaf.setActiveState(n, field.isValueOn(voxel) && !is_other);
            }
        });
        return is_alone;
    }

    // Sets voxels between bodies whose bands meet to the distance to this body.
    void separate(TreeT& result, const openvdb::BoolTree& inside) const
    {
        const auto grid = GridT::create(std::make_shared<TreeT>(result));
        grid->setGridClass(openvdb::GRID_LEVEL_SET);
        {
            InVoxels voxels(*grid, voxel_size_);
            // Wider than the band, so that a distance at its end does not equal its background.
            const double half_width = double(background_) / voxel_size_ + 1.0;
            redistance(*grid, half_width, 0.0, false);
            voxels.background = half_width * voxel_size_;
            voxels.leave();
        }
        const auto& alone = grid->tree();
        openvdb::tree::LeafManager<TreeT> leaves(result);
        leaves.foreach([&](auto& leaf, size_t) {
            openvdb::tree::ValueAccessor<const TreeT> field(tree_), distances(alone);
            openvdb::tree::ValueAccessor<const openvdb::BoolTree> own(inside);
            for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
                const auto voxel = leaf.offsetToGlobalCoord(n);
                if (own.isValueOn(voxel)) continue;
                const ValueT distance = distances.getValue(voxel), value = field.getValue(voxel);
                const bool is_own
                    = value >= ValueT(0) && std::abs(distance - value) <= ValueT(kSameDistance * voxel_size_);
                if (is_own) continue;
                const bool is_near = distance < background_ && distances.isValueOn(voxel);
                leaf.setValueOnly(n, is_near ? distance : background_);
                leaf.setActiveState(n, is_near);
            }
        });
    }

    const TreeT& tree_;
    ValueT background_;
    double voxel_size_;
    int layers_;
};

template<typename TreeT>
std::vector<typename TreeT::Ptr> bodies(const TreeT& tree, double voxel_size, double memory_limit)
{
    const auto inside = openvdb::tools::sdfInteriorMask(tree, typename TreeT::ValueType(0));
    if (kBytesPerMaskVoxel * double(inside->activeVoxelCount()) > memory_limit) {
        throw BridgeError(
            "memory", "the inside of the level set has too many voxels to be labelled; resample it first");
    }
    std::vector<openvdb::BoolTree::Ptr> insides;
    openvdb::tools::segmentActiveVoxels(*inside, insides);
    const Parts<TreeT> parts(tree, voxel_size);
    std::vector<typename TreeT::Ptr> result;
    for (const auto& mask : insides) {
        if (mask->activeVoxelCount() == 0) continue;
        openvdb::tools::prune(*mask); // labeling has made voxels of all tiles
        result.push_back(parts.part(*mask));
    }
    return result;
}

// OpenVDB's own segmentActiveVoxels() fills the leaves of masks.
std::vector<openvdb::MaskTree::Ptr> mask_parts(const openvdb::MaskTree& tree)
{
    std::vector<openvdb::BoolTree::Ptr> masks;
    openvdb::tools::extractActiveVoxelSegmentMasks(tree, masks);
    std::vector<openvdb::MaskTree::Ptr> parts;
    for (const auto& mask : masks) {
        parts.push_back(std::make_shared<openvdb::MaskTree>(*mask, false, openvdb::TopologyCopy()));
    }
    return parts;
}

} // namespace

std::vector<MappedBuffer> segment(const uint8_t* data, double voxel_size, double memory_limit)
{
    const auto grid = to_openvdb(data);
    const auto transform = grid->transformPtr();
    std::vector<MappedBuffer> buffers;
    const bool is_known = grid->apply<SegmentGrids>([&](auto& typed) {
        using TreeT = typename std::decay_t<decltype(typed)>::TreeType;
        std::vector<typename TreeT::Ptr> parts;
        if constexpr (std::is_same_v<TreeT, openvdb::MaskTree>) {
            parts = mask_parts(typed.tree());
        } else if constexpr (std::is_floating_point_v<typename TreeT::ValueType>) {
            if (typed.getGridClass() == openvdb::GRID_LEVEL_SET) parts = bodies(typed.tree(), voxel_size, memory_limit);
            else openvdb::tools::segmentActiveVoxels(typed.tree(), parts);
        } else {
            openvdb::tools::segmentActiveVoxels(typed.tree(), parts);
        }
        std::stable_sort(parts.begin(), parts.end(),
            [](const auto& a, const auto& b) { return a->activeVoxelCount() > b->activeVoxelCount(); });
        for (const auto& part : parts) {
            typed.setTree(part);
            typed.setTransform(transform);
            buffers.push_back(to_nanovdb(grid));
        }
    });
    if (!is_known) {
        throw BridgeError("unsupported", "segmentation does not take grids of type " + grid->valueType());
    }
    return buffers;
}

} // namespace geokit
