// OpenVDB's volumeToMesh on a grid that is ready in memory: prints the seconds of each run and the number of points and
// polygons. Arguments: file, isovalue, adaptivity, threads, runs.
#include <openvdb/openvdb.h>
#include <openvdb/tools/VolumeToMesh.h>
#include <tbb/global_control.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>

int main(int argc, char** argv)
{
    if (argc != 6) return 2;
    const double isovalue = std::atof(argv[2]), adaptivity = std::atof(argv[3]);
    tbb::global_control threads(tbb::global_control::max_allowed_parallelism, std::atoi(argv[4]));
    openvdb::initialize();
    openvdb::io::File file(argv[1]);
    file.open();
    auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid(file.beginName().gridName()));
    file.close();
    grid->tree().readNonresidentBuffers();
    const int runs = std::atoi(argv[5]);
    // A line on the input asks for a run, so that the caller can let the runs of two programs alternate.
    for (int run = 0; run < runs && std::getchar() != EOF; ++run) {
        const auto start = std::chrono::steady_clock::now();
        openvdb::tools::VolumeToMesh mesher(isovalue, adaptivity);
        mesher(*grid);
        const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
        size_t quads = 0, triangles = 0;
        for (size_t n = 0; n < mesher.polygonPoolListSize(); ++n) {
            quads += mesher.polygonPoolList()[n].numQuads();
            triangles += mesher.polygonPoolList()[n].numTriangles();
        }
        std::printf("%.6f %zu %zu %zu\n", seconds.count(), mesher.pointListSize(), triangles, quads);
        std::fflush(stdout);
    }
    return 0;
}
