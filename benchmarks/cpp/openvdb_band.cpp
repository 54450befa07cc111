// OpenVDB's meshToVolume and volumeToMesh alone, timed inside: for the benchmarks, also on machines that have only its
// libraries.

#include <openvdb/openvdb.h>
#include <openvdb/tools/MeshToVolume.h>
#include <openvdb/tools/VolumeToMesh.h>
#include <tbb/global_control.h>

#include <chrono>
#include <cstdint>
#include <vector>

namespace {

// The band made last, for openvdb_surface.
openvdb::FloatGrid::Ptr band;

} // namespace

// Seconds of one narrow band of `half_width` voxels on both sides; the number of active voxels in `active`.
extern "C" double openvdb_band(const double* points, int64_t point_count, const int32_t* triangles, int64_t triangle_count,
    double voxel_size, float half_width, int threads, int64_t* active)
{
    openvdb::initialize();
    tbb::global_control limit(tbb::global_control::max_allowed_parallelism, size_t(threads));
    std::vector<openvdb::Vec3s> vertices(point_count);
    std::vector<openvdb::Vec3I> faces(triangle_count);
    for (int64_t i = 0; i < point_count; ++i) {
        vertices[i] = openvdb::Vec3s(float(points[3 * i]), float(points[3 * i + 1]), float(points[3 * i + 2]));
    }
    for (int64_t i = 0; i < triangle_count; ++i) {
        faces[i] = openvdb::Vec3I(triangles[3 * i], triangles[3 * i + 1], triangles[3 * i + 2]);
    }
    const auto transform = openvdb::math::Transform::createLinearTransform(voxel_size);
    const auto start = std::chrono::steady_clock::now();
    band = openvdb::tools::meshToLevelSet<openvdb::FloatGrid>(*transform, vertices, faces, half_width);
    const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
    *active = int64_t(band->activeVoxelCount());
    return taken.count();
}

// Seconds of the surface of that band; the number of its quads in `quads`.
extern "C" double openvdb_surface(int threads, int64_t* quads)
{
    tbb::global_control limit(tbb::global_control::max_allowed_parallelism, size_t(threads));
    const auto start = std::chrono::steady_clock::now();
    openvdb::tools::VolumeToMesh mesher(0.0);
    mesher(*band);
    const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
    *quads = 0;
    for (size_t n = 0; n < mesher.polygonPoolListSize(); ++n) *quads += int64_t(mesher.polygonPoolList()[n].numQuads());
    return taken.count();
}
