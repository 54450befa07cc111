#include "operations.h"

#include "convert.h"

#include <openvdb/tools/Composite.h>
#include <openvdb/tools/Filter.h>
#include <openvdb/tools/LevelSetFilter.h>
#include <openvdb/tools/LevelSetMeasure.h>
#include <openvdb/tools/Prune.h>
#include <openvdb/tree/LeafManager.h>

#include <algorithm>
#include <cmath>

namespace geokit {
namespace {

// Returns op(grid) of the typed grid.
template<typename Op>
auto of_real(const openvdb::GridBase::Ptr& grid, const std::string& what, Op&& op)
{
    if (auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(grid)) return op(*floats);
    if (auto doubles = openvdb::gridPtrCast<openvdb::DoubleGrid>(grid)) return op(*doubles);
    throw BridgeError("unsupported", what + " needs a float or double grid, not " + grid->valueType());
}

// Calls op(grid) with the typed grid and returns the result as a buffer under the grid's original transform; operations
// may change the transform meanwhile.
template<typename Op>
MappedBuffer on_real(const openvdb::GridBase::Ptr& grid, const std::string& what, Op&& op)
{
    const auto transform = grid->transformPtr();
    of_real(grid, what, op);
    grid->setTransform(transform);
    return to_nanovdb(grid);
}

// Multiplies every value, including tiles and background. Values equal to the background's magnitude become exactly
// `background`, so that the conversion to voxels and back does not round them.
template<typename TreeT>
void scale_values(TreeT& tree, double factor, double background)
{
    using ValueT = typename TreeT::ValueType;
    const ValueT before = tree.background();
    const auto scaled = [=](ValueT value) {
        if (value == before) return ValueT(background);
        if (value == -before) return ValueT(-background);
        return ValueT(double(value) * factor);
    };
    openvdb::tree::LeafManager<TreeT> leaves(tree);
    leaves.foreach([&](auto& leaf, size_t) {
        ValueT* values = leaf.buffer().data();
        for (openvdb::Index i = 0; i < leaf.SIZE; ++i) values[i] = scaled(values[i]);
    });
    auto it = tree.beginValueAll();
    it.setMaxDepth(it.getLeafDepth() - 1);
    for (; it; ++it) it.setValue(scaled(*it));
    tree.root().setBackground(ValueT(background), /*updateChildNodes=*/false);
}

// Scales values and transform to voxels while the object lives; `half_width` may be changed meanwhile. OpenVDB's level
// set tools use the transform only for the size of a voxel, and treat small voxels as a singular transform.
template<typename GridT>
class InVoxels {
public:
    InVoxels(GridT& grid, double voxel_size) : grid_(grid), voxel_size_(voxel_size)
    {
        background = double(grid.background());
        scale_values(grid.tree(), 1.0 / voxel_size, background / voxel_size);
        grid.setTransform(openvdb::math::Transform::createLinearTransform(1.0));
    }
    void leave() { scale_values(grid_.tree(), voxel_size_, background); }

    double background; // after leave(), in the unit of the values

private:
    GridT& grid_;
    double voxel_size_;
};

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

template<typename GridT>
void smooth_level_set(
    GridT& grid, const std::string& method, int width, int iterations, double voxel_size, Interrupter& interrupter)
{
    InVoxels voxels(grid, voxel_size);
    {
        openvdb::tools::LevelSetFilter<GridT> filter(grid, &interrupter);
        for (int i = 0; i < iterations; ++i) {
            if (method == "gaussian") filter.gaussian(width);
            else if (method == "mean") filter.mean(width);
            else if (method == "median") filter.median(width);
            else if (method == "mean_curvature") filter.meanCurvature();
            else if (method == "laplacian") filter.laplacian();
            else throw BridgeError("input", "'" + method + "' is no smoothing method");
        }
    }
    voxels.leave();
}

template<typename GridT>
void smooth_field(GridT& grid, const std::string& method, int width, int iterations, Interrupter& interrupter)
{
    openvdb::tools::Filter<GridT> filter(grid, &interrupter);
    if (method == "gaussian") filter.gaussian(width, iterations);
    else if (method == "mean") filter.mean(width, iterations);
    else if (method == "median") filter.median(width, iterations);
    else throw BridgeError("input", "'" + method + "' smooths level sets only");
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

MappedBuffer smooth(
    const uint8_t* data, const std::string& method, int width, int iterations, double voxel_size, const Pulse& pulse)
{
    Interrupter interrupter(pulse);
    return on_real(to_openvdb(data), "smoothing", [&](auto& grid) {
        if (grid.getGridClass() == openvdb::GRID_LEVEL_SET)
            smooth_level_set(grid, method, width, iterations, voxel_size, interrupter);
        else smooth_field(grid, method, width, iterations, interrupter);
    });
}

std::pair<double, double> measure(const uint8_t* data, double voxel_size, const Pulse& pulse)
{
    Interrupter interrupter(pulse);
    return of_real(to_openvdb(data), "measuring", [&](auto& grid) -> std::pair<double, double> {
        const InVoxels voxels(grid, voxel_size);
        openvdb::tools::LevelSetMeasure<std::decay_t<decltype(grid)>, Interrupter> tool(grid, &interrupter);
        return {double(tool.area(false)), double(tool.volume(false))};
    });
}

} // namespace geokit
