#include "level_set.h"
#include "operations.h"

#include <openvdb/tools/Composite.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>

namespace geokit {
namespace {

enum class Kind { Union, Intersection, Difference };

Kind kind_of(const std::string& name)
{
    if (name == "union") return Kind::Union;
    if (name == "intersection") return Kind::Intersection;
    if (name == "difference") return Kind::Difference;
    throw BridgeError("input", "'" + name + "' is not one of union, intersection, difference");
}

template<typename TreeT>
typename TreeT::Ptr combined(const TreeT& a, const TreeT& b, Kind kind)
{
    switch (kind) {
    case Kind::Union: return openvdb::tools::csgUnionCopy(a, b);
    case Kind::Intersection: return openvdb::tools::csgIntersectionCopy(a, b);
    default: return openvdb::tools::csgDifferenceCopy(a, b);
    }
}

// As OpenVDB's pruneLevelSet, with the pulse before each node.
template<typename TreeT>
void prune(TreeT& tree, const Pulse& pulse)
{
    const openvdb::tools::LevelSetPruneOp<TreeT> op(tree);
    openvdb::tree::NodeManager<TreeT, TreeT::DEPTH - 2> nodes(tree);
    nodes.foreachBottomUp([&](auto& node) {
        pulse();
        op(node);
    });
}

// Quadratic polynomial smooth minimum (Quilez): the minimum if a and b differ by more than `blend`, else a blend with
// continuous slope.
double smooth_minimum(double a, double b, double blend)
{
    const double h = std::max(blend - std::abs(a - b), 0.0) / blend;
    return std::min(a, b) - 0.25 * h * h * blend;
}

double smooth_value(double a, double b, double blend, Kind kind)
{
    switch (kind) {
    case Kind::Union: return smooth_minimum(a, b, blend);
    case Kind::Intersection: return -smooth_minimum(-a, -b, blend);
    default: return -smooth_minimum(-a, b, blend);
    }
}

template<typename GridT>
const typename GridT::TreeType& second_tree(const openvdb::GridBase::Ptr& b)
{
    const auto typed = openvdb::gridPtrCast<GridT>(b);
    if (!typed) throw BridgeError("input", "both operands must be float or both double");
    return typed->tree();
}

} // namespace

MappedBuffer csg(const uint8_t* a, const uint8_t* b, const std::string& kind_name, const Pulse& pulse)
{
    const Kind kind = kind_of(kind_name);
    const auto second = to_openvdb(b);
    pulse();
    return on_real(to_openvdb(a), "CSG", [&](auto& grid) {
        using GridT = std::decay_t<decltype(grid)>;
        grid.setTree(combined(grid.tree(), second_tree<GridT>(second), kind));
        prune(grid.tree(), pulse);
    });
}

MappedBuffer smooth_csg(
    const uint8_t* a, const uint8_t* b, const std::string& kind_name, double blend, const Pulse& pulse)
{
    const Kind kind = kind_of(kind_name);
    const auto second = to_openvdb(b);
    return on_real(to_openvdb(a), "CSG", [&](auto& grid) {
        using GridT = std::decay_t<decltype(grid)>;
        using TreeT = typename GridT::TreeType;
        const TreeT& other = second_tree<GridT>(second);
        // The sharp result has the right nodes and the right signs far from the surfaces.
        const auto tree = combined(grid.tree(), other, kind);
        openvdb::tree::LeafManager<TreeT> leaves(*tree);
        leaves.foreach([&](auto& leaf, size_t) {
            pulse();
            openvdb::tree::ValueAccessor<const TreeT> left(grid.tree()), right(other);
            for (auto it = leaf.beginValueOn(); it; ++it) {
                const auto voxel = it.getCoord();
                const double value = smooth_value(left.getValue(voxel), right.getValue(voxel), blend, kind);
                it.setValue(typename TreeT::ValueType(value));
            }
        });
        grid.setTree(tree);
    });
}

} // namespace geokit
