// Unsigned distances of a tile's 512 voxels on the CPU: one tree walk per tile, then short lists of triangles.
//
// The walk collects the blocks of eight triangles within reach of the tile. Each brick of 2^3 voxels keeps the blocks
// that can be nearest to one of its voxels, and each voxel tests the few that its neighbor's distance leaves possible.
// As in the search for single points, float32 only selects candidates; float64 evaluates them.
#include "core/simd.inl"
#include "mesh/triangle/closest.inl"

// Returns 0, or 1 if the tile must be searched voxel by voxel.
static constexpr auto tile_distances = [](const SurfaceTree& tree, const wp::vec3i& voxel, const wp::vec3d& translation,
                                          double voxel_size, double reach, double offset, int row,
                                          wp::array_t<float>& out_distance, wp::array_t<int>& out_slot) -> int {
    float* out = out_distance.data + 512ll * row;
    int* out_winner = out_slot.data ? out_slot.data + 512ll * row : nullptr;
    double base[3], size = 0.0;
    for (int k = 0; k < 3; ++k) {
        base[k] = voxel[k] * voxel_size + translation[k];
        const double low = (base[k] - tree.origin[k]) / tree.scale, high = low + 7.0 * voxel_size / tree.scale;
        size = wp::max(size, wp::max(low < 0.0 ? -low : low, high < 0.0 ? -high : high));
    }
    // With voxels as large as the mesh, float32 would exclude nothing and squares might overflow.
    if (!(size <= FAR)) return 1;
    const float h = (float)(voxel_size / tree.scale);
    const float slack = 2.f * DISTANCE_ERROR * ((float)size + 1.f);
    const float band = (float)(reach / tree.scale) * 1.000001f;
    const v8 zero = 0.f, one = 1.f;
    alignas(64) float list[6][LIST + 8];
    int blocks[LIST + 8];
    int count = 0;
    auto box_squared = [&](const float* b, int stride, float lx, float ly, float lz, float ux, float uy, float uz) {
        const v8 dx = __builtin_elementwise_max(
            __builtin_elementwise_max(*(const v8*)b - ux, lx - *(const v8*)(b + 3 * stride)), zero);
        const v8 dy = __builtin_elementwise_max(
            __builtin_elementwise_max(*(const v8*)(b + stride) - uy, ly - *(const v8*)(b + 4 * stride)), zero);
        const v8 dz = __builtin_elementwise_max(
            __builtin_elementwise_max(*(const v8*)(b + 2 * stride) - uz, lz - *(const v8*)(b + 5 * stride)), zero);
        return dx * dx + dy * dy + dz * dz;
    };
    float low[3], high[3];
    for (int k = 0; k < 3; ++k) {
        low[k] = (float)((base[k] - tree.origin[k]) / tree.scale);
        high[k] = low[k] + 7.f * h;
    }
    {
        int stack[STACK], height = 1;
        stack[0] = 0;
        const float limit = (band + slack) * (band + slack);
        while (height > 0) {
            const int node = stack[--height];
            const float* side = tree.boxes.data + 48ll * node;
            const int* child = tree.children.data + 8ll * node;
            const v8 d2 = box_squared(side, 8, low[0], low[1], low[2], high[0], high[1], high[2]);
            for (unsigned mask = mask_of(d2 <= limit); mask; mask &= mask - 1) {
                const int j = __builtin_ctz(mask);
                if (child[j] >= 0) {
                    stack[height++] = child[j];
                    continue;
                }
                if (count == LIST) return 1;
                for (int k = 0; k < 6; ++k) list[k][count] = side[8 * k + j];
                blocks[count++] = -1 - child[j];
            }
        }
    }
    const float wide = (float)(reach - offset);
    for (int i = 0; i < 512; ++i) out[i] = wide;
    if (out_winner)
        for (int i = 0; i < 512; ++i) out_winner[i] = -1;
    if (count == 0) return 0;
    // The last group of eight is padded with boxes that nothing reaches.
    for (int i = count; i < ((count + 7) & ~7); ++i)
        for (int k = 0; k < 6; ++k) list[k][i] = k < 3 ? 1e18f : -1e18f;

    // Squared distances of points from a triangle in its frame: eight points, or eight triangles.
    auto distance_in_plane = [&](v8 x, v8 y, v8 z, v8 length, v8 cx, v8 cy, v8 along_ac, v8 along_bc) {
        #pragma clang fp contract(fast)
        const v8 ex = x - __builtin_elementwise_min(__builtin_elementwise_max(x, zero), length);
        v8 flat = ex * ex + y * y;
        const v8 bx = x - length, bcx = cx - length;
        const v8 s = __builtin_elementwise_min(__builtin_elementwise_max((x * cx + y * cy) * along_ac, zero), one);
        const v8 sx = x - s * cx, sy = y - s * cy;
        flat = __builtin_elementwise_min(flat, sx * sx + sy * sy);
        const v8 t = __builtin_elementwise_min(__builtin_elementwise_max((bx * bcx + y * cy) * along_bc, zero), one);
        const v8 tx = bx - t * bcx, ty = y - t * cy;
        flat = __builtin_elementwise_min(flat, tx * tx + ty * ty);
        const i8 inside = (y > zero) & (cy * x > cx * y) & (bcx * y > cy * bx);
        return (v8)((inside ? zero : flat) + z * z);
    };
    // Squared distances of one point from the eight triangles of a block.
    auto from_block = [&](int block, float X, float Y, float Z) {
        #pragma clang fp contract(fast)
        const v8* r = (const v8*)(tree.leaves.data + PLANE_ROWS * 8ll * block);
        const v8 ax = X - r[0], ay = Y - r[1], az = Z - r[2];
        return distance_in_plane(ax * r[3] + ay * r[4] + az * r[5], ax * r[6] + ay * r[7] + az * r[8],
                                 ax * r[9] + ay * r[10] + az * r[11], r[12], r[13], r[14], r[15], r[16]);
    };
    // Squared distances of eight points from the triangle in a slot.
    auto from_slot = [&](int slot, v8 X, v8 Y, v8 Z) {
        #pragma clang fp contract(fast)
        const float* r = tree.leaves.data + PLANE_ROWS * 8ll * (slot >> 3) + (slot & 7);
        const v8 ax = X - r[0], ay = Y - r[8], az = Z - r[16];
        return distance_in_plane(ax * r[24] + ay * r[32] + az * r[40], ax * r[48] + ay * r[56] + az * r[64],
                                 ax * r[72] + ay * r[80] + az * r[88], r[96] + zero, r[104] + zero, r[112] + zero,
                                 r[120] + zero, r[128] + zero);
    };
    alignas(32) float squared[8 * LIST];  // squared distances of the brick's center from the triangles of near blocks
    int near[LIST], slots[8 * LIST];
    v8 found[8 * LIST];
    const v8 step_x = {0.f, 0.f, 0.f, 0.f, h, h, h, h}, step_y = {0.f, 0.f, h, h, 0.f, 0.f, h, h};
    const v8 step_z = {0.f, h, 0.f, h, 0.f, h, 0.f, h};
    int seed = -1;
    float from_last = (float)UNBOUNDED;  // upper bound from the last brick's distance
    const float farthest = band + BRICK_RADIUS * h + slack;
    for (int n = 0; n < 64; ++n) {
        // Bricks run back and forth, so that each is adjacent to the one before it.
        const int i = n >> 4, j = i & 1 ? 3 - ((n >> 2) & 3) : (n >> 2) & 3, k = (n >> 2) & 1 ? 3 - (n & 3) : n & 3;
        const float x0 = low[0] + 2.f * i * h, y0 = low[1] + 2.f * j * h, z0 = low[2] + 2.f * k * h;
        const float X = x0 + 0.5f * h, Y = y0 + 0.5f * h, Z = z0 + 0.5f * h;
        float most = from_last < farthest ? from_last : farthest;
        if (seed >= 0) {
            const float d = __builtin_sqrtf(__builtin_reduce_min(from_block(seed, X, Y, Z))) + slack;
            most = d < most ? d : most;
        }
        // Triangles nearer to the center than this can be nearest to one of the eight voxels.
        float around = most + 2.f * BRICK_RADIUS * h;
        around = around < farthest ? around : farthest;
        around *= around;
        v8 least = UNBOUNDED;
        int near_count = 0;
        for (int m = 0; m < count; m += 8) {
            const v8 d2 = box_squared(&list[0][m], LIST + 8, X, Y, Z, X, Y, Z);
            for (unsigned mask = mask_of(d2 <= around); mask; mask &= mask - 1) {
                const int block = blocks[m + __builtin_ctz(mask)];
                const v8 of_block = from_block(block, X, Y, Z);
                *(v8*)(squared + 8 * near_count) = of_block;
                least = __builtin_elementwise_min(least, of_block);
                near[near_count++] = block;
            }
        }
        const float center = __builtin_sqrtf(__builtin_reduce_min(least));
        if (!(center <= farthest)) {
            // No voxel of this brick is in the band, so it gives no bound for the next brick.
            from_last = UNBOUNDED;
            seed = -1;
            continue;
        }
        from_last = center + 2.f * h * STEP + slack;
        around = center + 2.f * BRICK_RADIUS * h + slack;
        around = around < farthest ? around : farthest;
        around *= around;
        int slot_count = 0;
        float best = (float)UNBOUNDED;
        for (int m = 0; m < near_count; ++m) {
            const v8 d2 = *(const v8*)(squared + 8 * m);
            for (unsigned mask = mask_of(d2 <= around); mask; mask &= mask - 1) {
                const int lane = __builtin_ctz(mask);
                slots[slot_count++] = 8 * near[m] + lane;
                if (squared[8 * m + lane] < best) {
                    best = squared[8 * m + lane];
                    seed = near[m];
                }
            }
        }
        const v8 px = x0 + step_x, py = y0 + step_y, pz = z0 + step_z;
        v8 nearest = band * band;
        for (int m = 0; m < slot_count; ++m) {
            const v8 d2 = from_slot(slots[m], px, py, pz);
            found[m] = d2;
            nearest = __builtin_elementwise_min(nearest, d2);
        }
        const v8 root = __builtin_elementwise_sqrt(nearest) + slack;
        const v8 possible = root * root;
        const int* numbers = tree.slot_triangle.data;
        double exact[8];
        int winner[8];
        for (int v = 0; v < 8; ++v) {
            exact[v] = reach * reach;
            winner[v] = -1;
        }
        for (int m = 0; m < slot_count; ++m) {
            unsigned mask = mask_of(found[m] <= possible);
            if (!mask) continue;
            const int slot = slots[m], triangle = numbers[slot];
            if (triangle < 0) continue;
            const point a = tree.corners.data[3 * slot], b = tree.corners.data[3 * slot + 1],
                        c = tree.corners.data[3 * slot + 2];
            for (; mask; mask &= mask - 1) {
                const int lane = __builtin_ctz(mask);
                const point p((voxel[0] + 2 * i + (lane >> 2)) * voxel_size + translation[0],
                              (voxel[1] + 2 * j + ((lane >> 1) & 1)) * voxel_size + translation[1],
                              (voxel[2] + 2 * k + (lane & 1)) * voxel_size + translation[2]);
                double v, w;
                const double d2 = closest_on_triangle(p - a, b - a, c - a, v, w);
                if (d2 > exact[lane]) continue;
                // Ties go to the lowest triangle, so that answers do not depend on the order of the walk.
                if (d2 == exact[lane] && winner[lane] >= 0 && triangle > numbers[winner[lane]]) continue;
                exact[lane] = d2;
                winner[lane] = slot;
            }
        }
        for (int lane = 0; lane < 8; ++lane) {
            if (winner[lane] < 0) continue;
            const double distance = sqrt(exact[lane]);
            const int at = 64 * (2 * i + (lane >> 2)) + 8 * (2 * j + ((lane >> 1) & 1)) + 2 * k + (lane & 1);
            out[at] = (float)((distance < reach ? distance : reach) - offset);
            if (out_winner) out_winner[at] = winner[lane];
        }
    }
    return 0;
};
