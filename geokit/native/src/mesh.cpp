#include "convert.h"
#include "operations.h"

#include <openvdb/tools/MeshToVolume.h>
#include <openvdb/tools/VolumeToMesh.h>

#include <limits>

namespace geokit {

namespace pulsed {

using namespace openvdb::tools::mesh_to_volume_internal;

template<typename Tree>
inline constexpr bool kWhole<CombineLeafNodes<Tree>> = true;
template<typename A, typename B>
inline constexpr bool kWhole<UnionValueMasks<A, B>> = true;

template<typename Tree, typename Mesh>
struct Unowned<ExpandNarrowband<Tree, Mesh>> {
    static void destroy(ExpandNarrowband<Tree, Mesh>& body)
    {
        for (auto* leaf : body.newDistNodes()) delete leaf;
        for (auto* leaf : body.newIndexNodes()) delete leaf;
    }
};

} // namespace pulsed

namespace {

double determinant(const Affine& a)
{
    const auto& m = a.linear;
    return m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
}

template<typename GridT>
PolygonMesh polygonise(GridT& grid, double isovalue, double adaptivity, const Pulse& pulse)
{
    const Affine affine = affine_of(grid.transform());
    openvdb::CoordBBox bounds;
    if (!grid.tree().evalLeafBoundingBox(bounds)) return {};
    // OpenVDB returns float points in world space. Meshed in index space, relative to the first leaf, they keep about
    // 1e-5 voxel whatever the transform and wherever the grid lies; the transform is applied in double below.
    const openvdb::Vec3d first = bounds.min().asVec3d();
    grid.setTransform(openvdb::math::Transform::Ptr(
        new openvdb::math::Transform(openvdb::math::MapBase::Ptr(new openvdb::math::TranslationMap(-first)))));
    openvdb::tools::VolumeToMesh mesher(isovalue, adaptivity);
    mesher(grid);
    if (mesher.pointListSize() > size_t(std::numeric_limits<int32_t>::max())) {
        throw BridgeError("memory", "the surface has more than 2^31 points; resample the grid at a larger voxel size");
    }

    PolygonMesh mesh;
    mesh.points.resize(mesher.pointListSize());
    for (size_t i = 0; i < mesh.points.size(); ++i) {
        if (i % 4096 == 0) pulse();
        const openvdb::Vec3d index = openvdb::Vec3d(mesher.pointList()[i]) + first;
        for (int row = 0; row < 3; ++row) {
            const double* m = affine.linear[row];
            mesh.points[i][row] = m[0] * index[0] + m[1] * index[1] + m[2] * index[2] + affine.offset[row];
        }
    }
    // OpenVDB's polygons run clockwise; a mirroring transform reverses them once more.
    const bool reverse = determinant(affine) > 0.0;
    size_t triangle_count = 0, quad_count = 0;
    for (size_t n = 0; n < mesher.polygonPoolListSize(); ++n) {
        triangle_count += mesher.polygonPoolList()[n].numTriangles();
        quad_count += mesher.polygonPoolList()[n].numQuads();
    }
    mesh.triangles.reserve(triangle_count);
    mesh.quads.reserve(quad_count);
    for (size_t n = 0; n < mesher.polygonPoolListSize(); ++n) {
        pulse();
        const auto& pool = mesher.polygonPoolList()[n];
        for (size_t i = 0; i < pool.numTriangles(); ++i) {
            const auto& t = pool.triangle(i);
            if (reverse) mesh.triangles.push_back({int32_t(t[2]), int32_t(t[1]), int32_t(t[0])});
            else mesh.triangles.push_back({int32_t(t[0]), int32_t(t[1]), int32_t(t[2])});
        }
        for (size_t i = 0; i < pool.numQuads(); ++i) {
            const auto& q = pool.quad(i);
            if (reverse) mesh.quads.push_back({int32_t(q[3]), int32_t(q[2]), int32_t(q[1]), int32_t(q[0])});
            else mesh.quads.push_back({int32_t(q[0]), int32_t(q[1]), int32_t(q[2]), int32_t(q[3])});
        }
    }
    return mesh;
}

// OpenVDB's mesh interface over plain arrays. Points are converted to index space in double; OpenVDB's own class uses
// float.
struct MeshAdapter {
    const double* points;
    size_t count;
    const int32_t* triangles;
    size_t triangle_count;
    double voxel_size;

    size_t polygonCount() const { return triangle_count; }
    size_t pointCount() const { return count; }
    size_t vertexCount(size_t) const { return 3; }
    void getIndexSpacePoint(size_t triangle, size_t corner, openvdb::Vec3d& position) const
    {
        const double* point = points + 3 * size_t(triangles[3 * triangle + corner]);
        position = openvdb::Vec3d(point[0], point[1], point[2]) / voxel_size;
    }
};

} // namespace

PolygonMesh volume_to_mesh(const uint8_t* data, double isovalue, double adaptivity, const Pulse& pulse)
{
    initialize();
    const auto grid = to_openvdb(data);
    if (auto floats = openvdb::gridPtrCast<openvdb::FloatGrid>(grid))
        return polygonise(*floats, isovalue, adaptivity, pulse);
    if (auto doubles = openvdb::gridPtrCast<openvdb::DoubleGrid>(grid))
        return polygonise(*doubles, isovalue, adaptivity, pulse);
    throw BridgeError(
        "unsupported", "a surface can be taken from float and double grids, not from " + grid->valueType());
}

MappedBuffer mesh_to_level_set(const double* points, size_t point_count, const int32_t* triangles,
    size_t triangle_count, double voxel_size, double half_width, const Pulse& pulse)
{
    initialize();
    const MeshAdapter mesh{points, point_count, triangles, triangle_count, voxel_size};
    Affine affine{};
    for (int i = 0; i < 3; ++i) affine.linear[i][i] = voxel_size;
    const auto transform = transform_of(affine);
    const auto width = float(half_width);
    Interrupter interrupter(pulse);
    const auto grid = openvdb::tools::meshToVolume<openvdb::FloatGrid>(interrupter, mesh, *transform, width, width);
    return to_nanovdb(grid);
}

} // namespace geokit
