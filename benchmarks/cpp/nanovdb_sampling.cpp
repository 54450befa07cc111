// NanoVDB's own trilinear sampler over a float grid, for the benchmarks: one accessor a thread, contiguous shares.

#include <nanovdb/NanoVDB.h>
#include <nanovdb/util/SampleFromVoxels.h>

#include <cstdint>
#include <thread>
#include <vector>

extern "C" void sample(const void* buffer, const float* points, float* out, int64_t count, int threads)
{
    const auto& grid = *static_cast<const nanovdb::NanoGrid<float>*>(buffer);
    auto share = [&](int64_t begin, int64_t end) {
        auto accessor = grid.getAccessor();
        auto sampler = nanovdb::createSampler<1>(accessor);
        for (int64_t i = begin; i < end; ++i) {
            const nanovdb::Vec3f world(points[3 * i], points[3 * i + 1], points[3 * i + 2]);
            out[i] = sampler(grid.worldToIndexF(world));
        }
    };
    std::vector<std::thread> pool;
    for (int t = 0; t < threads; ++t) {
        pool.emplace_back(share, count * t / threads, count * (t + 1) / threads);
    }
    for (auto& thread : pool) thread.join();
}
