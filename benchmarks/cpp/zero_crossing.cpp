// Level-set rays by NanoVDB's ZeroCrossing, on as many threads as asked for; a peer of geokit.volume.raycast.
// Built by benchmarks/volume_rays.py: g++ -O3 -march=native -std=c++17 -shared -fPIC -pthread.
#include <nanovdb/NanoVDB.h>
#include <nanovdb/util/HDDA.h>
#include <nanovdb/util/Ray.h>

#include <atomic>
#include <cmath>
#include <thread>
#include <vector>

extern "C" void zero_crossing(
    const void* buffer, const float* origins, const float* directions, long count, int threads, float* out_t)
{
    const auto* grid = reinterpret_cast<const nanovdb::NanoGrid<float>*>(buffer);
    // Slices as in geokit: more than threads, so that a slow slice does not delay the end.
    const long slices = 8 * threads, size = (count + slices - 1) / slices;
    std::atomic<long> next{0};
    auto work = [&]() {
        auto accessor = grid->tree().getAccessor();
        for (long slice; (slice = next++) < slices;) {
            const long end = std::min(count, (slice + 1) * size);
            for (long i = slice * size; i < end; ++i) {
                const float *o = origins + 3 * i, *d = directions + 3 * i;
                nanovdb::Ray<float> world(nanovdb::Vec3f(o[0], o[1], o[2]), nanovdb::Vec3f(d[0], d[1], d[2]));
                auto ray = world.worldToIndexF(*grid);
                nanovdb::Coord ijk;
                float value, t;
                // worldToIndexF makes the direction a unit vector of index space.
                out_t[i] = nanovdb::ZeroCrossing(ray, accessor, ijk, value, t)
                             ? t / grid->worldToIndexDirF(nanovdb::Vec3f(d[0], d[1], d[2])).length()
                             : INFINITY;
            }
        }
    };
    std::vector<std::thread> pool;
    for (int n = 0; n < threads; ++n) pool.emplace_back(work);
    for (auto& thread : pool) thread.join();
}
