#include "convert.h"
#include "nano_types.h"
#include "open_grids.h" // before NanoVDB's converter, whose use of createGrid() it changes

#include <nanovdb/util/NanoToOpenVDB.h>

#include <memory>
#include <vector>

// NanoVDB's converter holds its nodes by plain pointers until the whole tree stands: an interrupt would leak them. Here the
// node of the second level, which most of a grid lies in, owns its children one by one.
namespace geokit {

template<typename OpenNode, typename NanoNode, typename Process>
OpenNode* second_level(const NanoNode& source, const Process& process)
{
    using OpenChild = typename OpenNode::ChildNodeType;
    using OpenValue = typename OpenNode::ValueType;
    auto node = std::make_unique<OpenNode>();
    node->setOrigin(source.origin());
    const_cast<typename OpenNode::NodeMaskType&>(node->getValueMask()) = source.valueMask();
    auto* table = const_cast<typename OpenNode::UnionType*>(node->getTable());
    std::vector<uint32_t> places;
    for (uint32_t n = 0; n < OpenNode::NUM_VALUES; ++n) {
        if (source.childMask().isOn(n)) places.push_back(n);
        else table[n].setValue(reinterpret_cast<const OpenValue&>(source.data()->mTable[n].value));
    }
    std::vector<std::unique_ptr<OpenChild>> children(places.size());
    pulsed::tbb::parallel_for(tbb::blocked_range<size_t>(0, places.size()), [&](const auto& range) {
        const PulseScope scope(nullptr);
        for (size_t i = range.begin(); i < range.end(); ++i) {
            children[i].reset(process(source.data()->getChild(places[i])));
        }
    });
    auto& mask = const_cast<typename OpenNode::NodeMaskType&>(node->getChildMask());
    for (size_t i = 0; i < places.size(); ++i) {
        table[places[i]].setChild(children[i].release());
        mask.setOn(places[i]);
    }
    return node.release();
}

} // namespace geokit

namespace nanovdb {

#define GEOKIT_SECOND_LEVEL(BuildT)                                                                                    \
    template<>                                                                                                         \
    template<>                                                                                                         \
    inline NanoToOpenVDB<BuildT>::OpenNode2*                                                                           \
    NanoToOpenVDB<BuildT>::processNode<NanoToOpenVDB<BuildT>::NanoNode2, NanoToOpenVDB<BuildT>::OpenNode2>(            \
        const NanoNode2* node)                                                                                         \
    {                                                                                                                  \
        return geokit::second_level<OpenNode2>(                                                                        \
            *node, [this](const NanoNode1* child) { return this->process(child); });                                   \
    }

GEOKIT_SECOND_LEVEL(float)
GEOKIT_SECOND_LEVEL(double)
GEOKIT_SECOND_LEVEL(int32_t)
GEOKIT_SECOND_LEVEL(int64_t)
GEOKIT_SECOND_LEVEL(uint32_t)
GEOKIT_SECOND_LEVEL(Vec3f)
GEOKIT_SECOND_LEVEL(Vec3d)
GEOKIT_SECOND_LEVEL(Vec4f)
GEOKIT_SECOND_LEVEL(Vec4d)
GEOKIT_SECOND_LEVEL(bool)
GEOKIT_SECOND_LEVEL(ValueMask)
GEOKIT_SECOND_LEVEL(Fp4)
GEOKIT_SECOND_LEVEL(Fp8)
GEOKIT_SECOND_LEVEL(Fp16)
GEOKIT_SECOND_LEVEL(FpN)

#undef GEOKIT_SECOND_LEVEL

} // namespace nanovdb

namespace geokit {

openvdb::GridBase::Ptr to_openvdb(const uint8_t* data, bool as_vec3i)
{
    initialize();
    const auto& header = *reinterpret_cast<const nanovdb::GridData*>(data);
    const auto transform = transform_of(affine_of(header.mMap));
    openvdb::GridBase::Ptr grid = dispatch(header.mGridType, [&](auto tag) -> openvdb::GridBase::Ptr {
        using BuildT = typename decltype(tag)::Type;
        return nanovdb::nanoToOpenVDB(*reinterpret_cast<const nanovdb::NanoGrid<BuildT>*>(data));
    });
    if (as_vec3i) {
        const auto doubles = openvdb::gridPtrCast<openvdb::Vec3DGrid>(grid);
        if (!doubles) throw BridgeError("input", "only a vec3d buffer can be written as integer vectors");
        grid = to_vec3i(*doubles);
    }
    // NanoVDB's converter stores an unknown class as metadata, where most programs store none.
    if (grid->getGridClass() == openvdb::GRID_UNKNOWN) grid->clearGridClass();
    // NanoVDB's own transform was rounded by OpenVDB's simplify().
    grid->setTransform(transform);
    return grid;
}

} // namespace geokit
