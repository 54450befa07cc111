// Redistancing in three steps.
//
// 1. Voxels at the corners of cells that the surface crosses are divided by the field's slope at the nearest point of
//    the surface, taken from the crossed cells around. Both ends of an edge across the surface then have the same
//    slope, so the crossing between them stays in place. (OpenVDB's own tools move it: LevelSetTracker::normalize by
//    0.02 to 0.5 voxel, sdfToSdf by 0.08.)
// 2. All other voxels of the band get distances along shortest paths over neighbors from those, up to a tenth too long.
// 3. The same voxels are improved by steps of phi_t = sign(phi) (1 - |grad phi|) with fifth-order upwind differences,
//    while the voxels of step 1 stay fixed.
#include "redistance.h"

#include "errors.h"
#include "level_set.h"
#include "normalize.h"

#include <openvdb/tools/Morphology.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <array>

namespace geokit {
namespace {

// Steps per voxel of the band, half as many again as information needs to cross it, so that errors are carried out.
constexpr double kStepsPerVoxel = 5.0;
// Slopes this close to 1 are within the error of differences on a sphere with a radius of five voxels: the values are
// distances already and keep their bits.
constexpr double kUnitSlope = 0.01;
// At an edge between faces, the cells on the edge have smaller slopes than those on the faces; they are a minority.
constexpr double kSlopeQuantile = 0.75;
// Scatter of slopes around a linear function, as a share of the slope, where the field is smooth; at edges it is 0.1.
constexpr double kFitError = 0.02;
// Variance of the cells' positions [voxels^2] that counts as none; along a surface it is about 1.
constexpr double kRidge = 0.05;

// Values of a leaf and two voxels around it.
template<typename TreeT>
class Neighborhood {
public:
    using ValueT = typename TreeT::ValueType;
    static constexpr int kReach = 2;
    static constexpr int kWidth = 8 + 2 * kReach;

    void read(const openvdb::tree::ValueAccessor<const TreeT>& tree, const openvdb::Coord& origin, double isovalue)
    {
        ValueT* out = values_.data();
        for (int x = -kReach; x < 8 + kReach; ++x) {
            for (int y = -kReach; y < 8 + kReach; ++y) {
                for (int z = -kReach; z < 8 + kReach; ++z) {
                    *out++ = ValueT(double(tree.getValue(origin.offsetBy(x, y, z))) - isovalue);
                }
            }
        }
    }

    ValueT at(int x, int y, int z) const { return values_[((x + kReach) * kWidth + y + kReach) * kWidth + z + kReach]; }

    // Slope of the field in the cell that starts at a voxel, or -1 where the surface does not cross it.
    double slope(int x, int y, int z) const
    {
        double corner[2][2][2];
        int inside = 0;
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j)
                for (int k = 0; k < 2; ++k) inside += (corner[i][j][k] = double(at(x + i, y + j, z + k))) < 0.0;
        if (inside == 0 || inside == 8) return -1.0;
        double sum[3] = {};
        for (int i = 0; i < 2; ++i) {
            for (int j = 0; j < 2; ++j) {
                sum[0] += corner[1][i][j] - corner[0][i][j];
                sum[1] += corner[i][1][j] - corner[i][0][j];
                sum[2] += corner[i][j][1] - corner[i][j][0];
            }
        }
        return 0.25 * std::sqrt(sum[0] * sum[0] + sum[1] * sum[1] + sum[2] * sum[2]);
    }

private:
    std::array<ValueT, kWidth * kWidth * kWidth> values_;
};

// Slopes of the crossed cells around a voxel.
class Slopes {
public:
    void clear() { count_ = 0; }
    int count() const { return count_; }
    void add(const openvdb::Vec3d& position, double slope)
    {
        positions_[count_] = position;
        slopes_[count_++] = slope;
    }

    // Slope of the field at a point of the surface: from a linear fit where the slopes follow one, else their quantile.
    double at(const openvdb::Vec3d& point)
    {
        openvdb::Vec3d centre(0.0);
        double mean = 0.0;
        for (int i = 0; i < count_; ++i) {
            centre += positions_[i] / count_;
            mean += slopes_[i] / count_;
        }
        // Crossed cells of a flat surface lie in a plane: the second term keeps the system regular.
        openvdb::Mat3d spread = openvdb::Mat3d::identity() * kRidge;
        openvdb::Vec3d along(0.0);
        double square = 0.0;
        for (int i = 0; i < count_; ++i) {
            const openvdb::Vec3d d = positions_[i] - centre;
            const double s = slopes_[i] - mean;
            for (int row = 0; row < 3; ++row)
                for (int column = 0; column < 3; ++column) spread(row, column) += d[row] * d[column] / count_;
            along += d * s / count_;
            square += s * s / count_;
        }
        const openvdb::Vec3d rise = spread.inverse() * along;
        if (square - rise.dot(along) < kFitError * kFitError * mean * mean) return mean + rise.dot(point - centre);
        const int rank = int(kSlopeQuantile * (count_ - 1) + 0.5);
        std::nth_element(slopes_.begin(), slopes_.begin() + rank, slopes_.begin() + count_);
        return slopes_[rank];
    }

private:
    int count_ = 0;
    std::array<openvdb::Vec3d, 64> positions_;
    std::array<double, 64> slopes_;
};

// The point of the surface nearest to a voxel, by the field's gradient there.
template<typename TreeT>
openvdb::Vec3d foot(const Neighborhood<TreeT>& field, int x, int y, int z)
{
    const openvdb::Vec3d gradient(0.5 * (double(field.at(x + 1, y, z)) - double(field.at(x - 1, y, z))),
        0.5 * (double(field.at(x, y + 1, z)) - double(field.at(x, y - 1, z))),
        0.5 * (double(field.at(x, y, z + 1)) - double(field.at(x, y, z - 1))));
    const double squared = gradient.lengthSqr();
    const openvdb::Vec3d step = squared > 0.0 ? gradient * (double(field.at(x, y, z)) / squared) : openvdb::Vec3d(0.0);
    // A corner of a crossed cell is no farther from the surface than a cell's diagonal.
    const double length = step.length();
    return openvdb::Vec3d(x, y, z) - (length > 1.8 ? step * (1.8 / length) : step);
}

// Converts the corners of crossed cells of a leaf to distances and deactivates its other voxels.
template<typename LeafT, typename TreeT>
void seed_leaf(LeafT& leaf, const Neighborhood<TreeT>& field, typename TreeT::ValueType background)
{
    using ValueT = typename TreeT::ValueType;
    constexpr int width = 11; // cells from -2 to 8
    std::array<double, width * width * width> slopes;
    bool is_crossed = false;
    for (int x = 0, n = 0; x < width; ++x)
        for (int y = 0; y < width; ++y)
            for (int z = 0; z < width; ++z, ++n) {
                slopes[n] = field.slope(x - 2, y - 2, z - 2);
                is_crossed = is_crossed || slopes[n] >= 0.0;
            }
    Slopes near;
    for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
        const int x = int(n >> 6), y = int(n >> 3 & 7), z = int(n & 7);
        const ValueT value = field.at(x, y, z);
        bool is_corner = false;
        for (int corner = 0; is_crossed && corner < 8; ++corner) {
            const int i = 1 + (corner >> 2), j = 1 + (corner >> 1 & 1), k = 1 + (corner & 1);
            is_corner = is_corner || slopes[((x + i) * width + y + j) * width + z + k] >= 0.0;
        }
        // Inactive values are the background, not distances, if the band is narrower than a cell.
        if (!is_corner || !leaf.isValueOn(n)) {
            leaf.setValueOff(n, value < ValueT(0) ? -background : background);
            continue;
        }
        near.clear();
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < 4; ++k) {
                    const double slope = slopes[((x + i) * width + y + j) * width + z + k];
                    if (slope >= 0.0) near.add(openvdb::Vec3d(x + i - 1.5, y + j - 1.5, z + k - 1.5), slope);
                }
        double slope = near.at(foot(field, x, y, z));
        if (std::abs(slope - 1.0) < kUnitSlope || !(slope > 0.0) || !std::isfinite(slope)) slope = 1.0;
        leaf.setValueOn(n, ValueT(double(value) / slope));
    }
}

template<typename GridT>
void seed(GridT& grid, const typename GridT::TreeType& source, double isovalue)
{
    using TreeT = typename GridT::TreeType;
    const auto background = grid.background();
    openvdb::tree::LeafManager<TreeT> leaves(grid.tree());
    leaves.foreach([&](auto& leaf, size_t) {
        const openvdb::tree::ValueAccessor<const TreeT> tree(source);
        Neighborhood<TreeT> field;
        field.read(tree, leaf.origin(), isovalue);
        seed_leaf(leaf, field, background);
    });
    // Tiles between 0 and the isovalue change sides.
    auto it = grid.tree().beginValueAll();
    it.setMaxDepth(it.getLeafDepth() - 1);
    for (; it; ++it) {
        it.setValue(double(*it) - isovalue < 0.0 ? -background : background);
        it.setValueOff();
    }
}

// Leaves the voxels nearer than `half_width` active; all others become the background of their side.
template<typename TreeT>
void trim(TreeT& tree, double half_width)
{
    using ValueT = typename TreeT::ValueType;
    const ValueT background(half_width);
    openvdb::tree::LeafManager<TreeT> leaves(tree);
    leaves.foreach([&](auto& leaf, size_t) {
        for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
            const ValueT value = leaf.getValue(n);
            if (leaf.isValueOn(n) && std::abs(value) < background) continue;
            leaf.setValueOff(n, value < ValueT(0) ? -background : background);
        }
    });
    auto it = tree.beginValueAll();
    it.setMaxDepth(it.getLeafDepth() - 1);
    for (; it; ++it) {
        it.setValue(*it < ValueT(0) ? -background : background);
        it.setValueOff();
    }
    tree.root().setBackground(background, /*updateChildNodes=*/false);
    openvdb::tools::pruneLevelSet(tree);
}

// Shortest paths over neighbors are longer than the distance by up to this factor (0.09 in the worst direction).
constexpr double kLongestWay = 1.1;
// Larger than the length of any path over neighbors.
template<typename ValueT>
constexpr ValueT kFar = ValueT(1e30);

// Sets every voxel that is not fixed to a distance beyond all relevant ones, on its side.
template<typename TreeT>
void forget(TreeT& tree, const TreeT& fixed, double beyond)
{
    using ValueT = typename TreeT::ValueType;
    openvdb::tree::LeafManager<TreeT> leaves(tree);
    leaves.foreach([&](auto& leaf, size_t) {
        const auto* held = fixed.probeConstLeaf(leaf.origin());
        for (openvdb::Index n = 0; n < leaf.SIZE; ++n) {
            if (held && held->isValueOn(n)) continue;
            leaf.setValueOnly(n, leaf.getValue(n) < ValueT(0) ? ValueT(-beyond) : ValueT(beyond));
        }
    });
    auto it = tree.beginValueAll();
    it.setMaxDepth(it.getLeafDepth() - 1);
    for (; it; ++it) it.setValue(*it < ValueT(0) ? ValueT(-beyond) : ValueT(beyond));
    tree.root().setBackground(ValueT(beyond), /*updateChildNodes=*/false);
}

// First distances for the active voxels that are inactive in `fixed`: shortest paths over the 26 neighbors, from both
// sides at once.
template<typename TreeT>
void spread(TreeT& tree, const TreeT& fixed, int rounds)
{
    using ValueT = typename TreeT::ValueType;
    constexpr int width = 10;
    openvdb::tree::LeafManager<TreeT> leaves(tree, /*auxBuffersPerLeaf=*/1);
    for (int round = 0; round < rounds; ++round) {
        leaves.foreach([&](auto& leaf, size_t index) {
            const auto* held = fixed.probeConstLeaf(leaf.origin());
            const openvdb::tree::ValueAccessor<const TreeT> field(tree);
            std::array<ValueT, width * width * width> near;
            for (int x = 0, n = 0; x < width; ++x)
                for (int y = 0; y < width; ++y)
                    for (int z = 0; z < width; ++z, ++n)
                        near[n] = std::abs(field.getValue(leaf.origin().offsetBy(x - 1, y - 1, z - 1)));
            ValueT* result = leaves.getBuffer(index, 1).data();
            for (auto it = leaf.cbeginValueOn(); it; ++it) {
                if (held && held->isValueOn(it.pos())) continue;
                const int x = int(it.pos() >> 6), y = int(it.pos() >> 3 & 7), z = int(it.pos() & 7);
                ValueT least[4] = {std::abs(*it), kFar<ValueT>, kFar<ValueT>, kFar<ValueT>}; // by axes of the step
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j)
                        for (int k = 0; k < 3; ++k) {
                            ValueT& best = least[(i != 1) + (j != 1) + (k != 1)];
                            best = std::min(best, near[((x + i) * width + y + j) * width + z + k]);
                        }
                const ValueT way = std::min(std::min(least[0], least[1] + ValueT(1)),
                    std::min(least[2] + ValueT(1.41421356237), least[3] + ValueT(1.73205080757)));
                result[it.pos()] = *it < ValueT(0) ? -way : way;
            }
        });
        leaves.swapLeafBuffer(1); // fixed voxels are the same in both buffers
    }
}

} // namespace

template<typename GridT>
void redistance(GridT& grid, double half_width, double isovalue, bool keeps_band)
{
    auto& tree = grid.tree();
    const double old_width = double(grid.background());
    if (!keeps_band) {
        const auto source = std::static_pointer_cast<typename GridT::TreeType>(tree.copy());
        seed(grid, *source, isovalue);
    }
    const auto fixed = std::static_pointer_cast<typename GridT::TreeType>(tree.copy());
    const double reach = keeps_band ? std::max(half_width - old_width, 0.0) : half_width;
    if (reach > 0.0 && fixed->activeVoxelCount() > 0) {
        // One layer more than the band, which upwind differences at its border need.
        const int layers = int(std::ceil(reach)) + 1;
        openvdb::tools::dilateActiveValues(
            tree, layers, openvdb::tools::NN_FACE_EDGE_VERTEX, openvdb::tools::IGNORE_TILES);
        forget(tree, *fixed, half_width + 2.0 * layers);
        spread(tree, *fixed, layers + 1);
        trim(grid.tree(), kLongestWay * (half_width + 1.0));
        Normalizer<typename GridT::TreeType> normalizer(grid.tree(), *fixed);
        const int steps = int(std::ceil(kStepsPerVoxel * (reach + 1.0)));
        for (int i = 0; i < steps; ++i) normalizer.step();
    }
    trim(grid.tree(), half_width);
}

template void redistance(openvdb::FloatGrid&, double, double, bool);
template void redistance(openvdb::DoubleGrid&, double, double, bool);

} // namespace geokit
