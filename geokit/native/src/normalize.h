// Steps towards slope 1 at selected voxels of a level set, leaf by leaf.
#pragma once

#include <openvdb/openvdb.h>
#include <openvdb/tree/LeafManager.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace geokit {

// Time step of the explicit Euler scheme [voxels]; the same as OpenVDB's.
constexpr double kTimeStep = 0.3;

// Upwind slope from five differences, of fifth order where the field is smooth (Jiang and Peng 2000).
template<typename T>
inline T weno(T a, T b, T c, T d, T e)
{
    const T tiny = T(1e-8), curve = T(13.0 / 12.0), quarter = T(0.25);
    const auto squared = [](T x) { return x * x; };
    const T s1 = curve * squared(a - T(2) * b + c) + quarter * squared(a - T(4) * b + T(3) * c) + tiny;
    const T s2 = curve * squared(b - T(2) * c + d) + quarter * squared(b - d) + tiny;
    const T s3 = curve * squared(c - T(2) * d + e) + quarter * squared(T(3) * c - T(4) * d + e) + tiny;
    const T w1 = T(0.1) / (s1 * s1), w2 = T(0.6) / (s2 * s2), w3 = T(0.3) / (s3 * s3);
    const T sum
        = w1 * (T(2) * a - T(7) * b + T(11) * c) + w2 * (T(5) * c - b + T(2) * d) + w3 * (T(2) * c + T(5) * d - e);
    return sum / (T(6) * (w1 + w2 + w3));
}

// Does the same as LevelSetTracker::normalize with a mask, but a whole leaf at a time instead of one voxel's stencil,
// which is ten times as fast and quick to compile.
template<typename TreeT>
class Normalizer {
public:
    using T = typename TreeT::ValueType;
    using Leaf = typename TreeT::LeafNodeType;

    // Voxels that are active in `tree` and inactive in `fixed` are changed.
    Normalizer(TreeT& tree, const TreeT& fixed) : leaves_(tree, /*auxBuffersPerLeaf=*/1), beside_(leaves_.leafCount())
    {
        leaves_.foreach([&](Leaf& leaf, size_t index) {
            auto& beside = beside_[index];
            beside.mutable_voxels = leaf.getValueMask();
            if (const Leaf* held = fixed.probeConstLeaf(leaf.origin())) beside.mutable_voxels -= held->getValueMask();
            for (int side = 0; side < 6; ++side) {
                openvdb::Coord origin = leaf.origin();
                origin[side / 2] += side % 2 ? 8 : -8;
                beside.leaf[side] = tree.probeConstLeaf(origin);
                beside.tile[side] = beside.leaf[side] ? T(0) : tree.getValue(origin);
            }
        });
    }

    void step()
    {
        leaves_.foreach([&](Leaf& leaf, size_t index) {
            const auto& beside = beside_[index];
            if (beside.mutable_voxels.isOff()) return;
            const T* phi = leaf.buffer().data();
            std::array<T, 512> squared{};
            for (int axis = 0; axis < 3; ++axis) add_slopes(phi, beside, axis, squared);
            T* result = leaves_.getBuffer(index, 1).data();
            for (auto it = beside.mutable_voxels.beginOn(); it; ++it) {
                const T value = phi[it.pos()], norm = squared[it.pos()];
                const T sign = value / (std::sqrt(value * value + norm) + T(1e-12));
                result[it.pos()] = value - T(kTimeStep) * sign * (std::sqrt(norm) - T(1));
            }
        });
        leaves_.swapLeafBuffer(1); // voxels that are not changed are the same in both buffers
    }

private:
    struct Beside {
        const Leaf* leaf[6];
        T tile[6];
        typename Leaf::NodeMaskType mutable_voxels;
    };

    // Offset of voxel (row, lane), where rows run along an axis and lanes number the other two.
    static int place(int axis, int row, int lane)
    {
        const int high = lane >> 3, low = lane & 7;
        if (axis == 0) return row << 6 | lane;
        if (axis == 1) return high << 6 | row << 3 | low;
        return high << 6 | low << 3 | row;
    }

    static void add_slopes(const T* phi, const Beside& beside, int axis, std::array<T, 512>& squared)
    {
        std::array<std::array<T, 64>, 14> rows; // three of the leaf below, eight, three of the leaf above
        const T* below = beside.leaf[2 * axis] ? beside.leaf[2 * axis]->buffer().data() : nullptr;
        const T* above = beside.leaf[2 * axis + 1] ? beside.leaf[2 * axis + 1]->buffer().data() : nullptr;
        for (int lane = 0; lane < 64; ++lane) {
            for (int row = 0; row < 3; ++row) {
                rows[row][lane] = below ? below[place(axis, row + 5, lane)] : beside.tile[2 * axis];
                rows[row + 11][lane] = above ? above[place(axis, row, lane)] : beside.tile[2 * axis + 1];
            }
            for (int row = 0; row < 8; ++row) rows[row + 3][lane] = phi[place(axis, row, lane)];
        }
        for (int row = 0; row < 8; ++row) {
            std::array<T, 64> larger;
            for (int lane = 0; lane < 64; ++lane) {
                const auto at = [&](int step) { return rows[row + 3 + step][lane]; };
                const T d0 = at(-2) - at(-3), d1 = at(-1) - at(-2), d2 = at(0) - at(-1);
                const T d3 = at(1) - at(0), d4 = at(2) - at(1), d5 = at(3) - at(2);
                const T side = at(0) > T(0) ? T(1) : T(-1);
                // Godunov: uses only slopes that carry information away from the surface.
                const T back = std::max(side * weno(d0, d1, d2, d3, d4), T(0));
                const T front = std::min(side * weno(d5, d4, d3, d2, d1), T(0));
                larger[lane] = std::max(back * back, front * front);
            }
            for (int lane = 0; lane < 64; ++lane) squared[place(axis, row, lane)] += larger[lane];
        }
    }

    openvdb::tree::LeafManager<TreeT> leaves_;
    std::vector<Beside> beside_;
};

} // namespace geokit
