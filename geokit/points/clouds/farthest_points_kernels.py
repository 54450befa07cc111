"""Greedy farthest point sampling over points in leaves and groups of leaves, each with a box and its farthest point.

The whole greedy loop runs in one launch: a launch for each point taken would cost more than its step does. It cannot
be cut among the CPU's threads or the GPU's blocks.
"""

# mypy: ignore-errors
# Annotations of kernels are warp's, not Python's.
import warp as wp

# The distance from a box never exceeds that of a point in it, rounding included, only if both are rounded term by term.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1})

# The native loop has these numbers written down: 64 is a cache-friendly run of points, and the bits of a mask.
LEAF_POINTS = wp.constant(64)
GROUP_LEAVES = wp.constant(64)
GROUP_POINTS = wp.constant(4096)
NOBODY = wp.constant(2147483647)


@wp.struct
class SampledCloud:
    """Points in leaves of LEAF_POINTS and groups of GROUP_LEAVES leaves.

    ``squared`` is a point's squared distance from those taken; -1 for those taken and for padding. A leaf or group has
    its box (six arrays one after the other: lower x, y, z, upper x, y, z), the largest ``squared`` in it, and the
    position of the point that has it, of several the one with the lowest index.
    """

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    z: wp.array(dtype=wp.float64)
    squared: wp.array(dtype=wp.float64)
    index: wp.array(dtype=wp.int32)
    leaf_box: wp.array(dtype=wp.float64)
    leaf_far: wp.array(dtype=wp.float64)
    leaf_at: wp.array(dtype=wp.int32)
    group_box: wp.array(dtype=wp.float64)
    group_far: wp.array(dtype=wp.float64)
    group_at: wp.array(dtype=wp.int32)
    group_count: wp.int32


# Warp's language has neither vectors of eight doubles nor votes among the threads of a CUDA warp. Both branches take
# the same point: the largest squared distance, of equal ones the lowest index. A leaf whose box is no nearer to the new
# point than the leaf's farthest point is to one taken does not change: no minimum in it would, bit for bit.
GREEDY = """
    const double* const x = cloud.x.data;
    const double* const y = cloud.y.data;
    const double* const z = cloud.z.data;
    double* const squared = cloud.squared.data;
    const int* const index = cloud.index.data;
    const int groups = cloud.group_count;
    const int leaves = groups * 64;
    const double* const leaf_box = cloud.leaf_box.data;
    const double* const group_box = cloud.group_box.data;
    double* const leaf_far = cloud.leaf_far.data;
    double* const group_far = cloud.group_far.data;
    int* const leaf_at = cloud.leaf_at.data;
    int* const group_at = cloud.group_at.data;
    const auto keep_better = [&](double& far, int& at, double other_far, int other_at) {
        if (other_at < 0)
            return;
        if (at < 0 || other_far > far || (other_far == far && index[other_at] < index[at])) {
            far = other_far;
            at = other_at;
        }
    };
    int current = start.data[0];
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int team = threadIdx.x >> 5;
    const int teams = blockDim.x >> 5;
    __shared__ double shared_far[32];
    __shared__ int shared_at[32];
    const auto gap = [](const double* box, int stride, int b, double px, double py, double pz) {
        const double gx = fmax(fmax(box[b] - px, px - box[3 * stride + b]), 0.0);
        const double gy = fmax(fmax(box[stride + b] - py, py - box[4 * stride + b]), 0.0);
        const double gz = fmax(fmax(box[2 * stride + b] - pz, pz - box[5 * stride + b]), 0.0);
        return (gx * gx + gy * gy) + gz * gz;
    };
    const auto best_of_team = [&](double& far, int& at) {
        for (int step = 16; step > 0; step >>= 1) {
            const double other_far = __shfl_xor_sync(all, far, step);
            const int other_at = __shfl_xor_sync(all, at, step);
            keep_better(far, at, other_far, other_at);
        }
    };
    for (int taken = 0; taken < count; ++taken) {
        if (threadIdx.x == 0)
            out_index.data[taken] = index[current];
        const double px = x[current], py = y[current], pz = z[current];
        double far = -2.0;
        int at = -1;
        for (int base = team * 32; base < groups; base += teams * 32) {
            const int mine = base + lane;
            const bool go = mine < groups
                && (mine == (current >> 12) || gap(group_box, groups, mine, px, py, pz) < group_far[mine]);
            for (unsigned mask = __ballot_sync(all, go); mask; mask &= mask - 1) {
                const int group = base + __ffs(mask) - 1;
                double group_best = -2.0;
                int group_best_at = -1;
                for (int half = 0; half < 64; half += 32) {
                    const int own = group * 64 + half + lane;
                    const bool near
                        = own == (current >> 6) || gap(leaf_box, leaves, own, px, py, pz) < leaf_far[own];
                    for (unsigned wanted = __ballot_sync(all, near); wanted; wanted &= wanted - 1) {
                        const int leaf = group * 64 + half + __ffs(wanted) - 1;
                        double best = -2.0;
                        int best_at = -1;
                        for (int k = lane; k < 64; k += 32) {
                            const int i = leaf * 64 + k;
                            const double dx = x[i] - px, dy = y[i] - py, dz = z[i] - pz;
                            const double d = (dx * dx + dy * dy) + dz * dz;
                            const double old = i == current ? -1.0 : squared[i];
                            const double now = d < old ? d : old;
                            squared[i] = now;
                            keep_better(best, best_at, now, i);
                        }
                        best_of_team(best, best_at);
                        if (lane == 0) {
                            leaf_far[leaf] = best;
                            leaf_at[leaf] = best_at;
                        }
                    }
                    __syncwarp();
                    keep_better(group_best, group_best_at, leaf_far[own], leaf_at[own]);
                }
                best_of_team(group_best, group_best_at);
                if (lane == 0) {
                    group_far[group] = group_best;
                    group_at[group] = group_best_at;
                }
            }
            __syncwarp();
            if (mine < groups)
                keep_better(far, at, group_far[mine], group_at[mine]);
        }
        best_of_team(far, at);
        if (lane == 0) {
            shared_far[team] = far;
            shared_at[team] = at;
        }
        __syncthreads();
        far = -2.0;
        at = -1;
        for (int k = 0; k < teams; ++k)
            keep_better(far, at, shared_far[k], shared_at[k]);
        current = at;
        __syncthreads();
    }
#else
    typedef double lanes __attribute__((ext_vector_type(8), aligned(8)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    for (int taken = 0; taken < count; ++taken) {
        out_index.data[taken] = index[current];
        squared[current] = -1.0;
        const lanes px = (lanes)(x[current]), py = (lanes)(y[current]), pz = (lanes)(z[current]);
        const lanes zero = (lanes)(0.0);
        // One bit for each of eight boxes that hold a point which the new one may be nearest to.
        const auto changed = [&](const double* box, const double* far, int stride, int b) {
            const auto beside = [&](int axis, lanes p) {
                const lanes below = *(const lanes*)(box + axis * stride + b) - p;
                const lanes above = p - *(const lanes*)(box + (3 + axis) * stride + b);
                const lanes outside = below > above ? below : above;
                return outside > zero ? outside : zero;
            };
            const lanes gx = beside(0, px), gy = beside(1, py), gz = beside(2, pz);
            const lanes gap = (gx * gx + gy * gy) + gz * gz;
            const flags near = __builtin_convertvector(gap < *(const lanes*)(far + b), flags);
            return (unsigned)__builtin_bit_cast(unsigned char, near);
        };
        const int current_leaf = current >> 6, current_group = current >> 12;
        double far = -2.0;
        int at = -1;
        for (int base = 0; base < groups; base += 8) {
            unsigned wanted = changed(group_box, group_far, groups, base);
            // The point taken leaves its own boxes even where all of their points are equal.
            if ((current_group & ~7) == base)
                wanted |= 1u << (current_group & 7);
            for (; wanted; wanted &= wanted - 1) {
                const int group = base + __builtin_ctz(wanted);
                for (int row = group * 64; row < group * 64 + 64; row += 8) {
                    unsigned near = changed(leaf_box, leaf_far, leaves, row);
                    if ((current_leaf & ~7) == row)
                        near |= 1u << (current_leaf & 7);
                    for (; near; near &= near - 1) {
                        const int leaf = row + __builtin_ctz(near);
                        lanes most = (lanes)(-1.0);
                        for (int k = leaf * 64; k < leaf * 64 + 64; k += 8) {
                            const lanes dx = *(const lanes*)(x + k) - px;
                            const lanes dy = *(const lanes*)(y + k) - py;
                            const lanes dz = *(const lanes*)(z + k) - pz;
                            const lanes d = (dx * dx + dy * dy) + dz * dz;
                            const lanes old = *(const lanes*)(squared + k);
                            const lanes now = d < old ? d : old;
                            *(lanes*)(squared + k) = now;
                            most = now > most ? now : most;
                        }
                        double best = most[0];
                        for (int k = 1; k < 8; ++k)
                            best = most[k] > best ? most[k] : best;
                        int best_at = -1;
                        for (int k = leaf * 64; k < leaf * 64 + 64; ++k)
                            if (squared[k] == best && (best_at < 0 || index[k] < index[best_at]))
                                best_at = k;
                        leaf_far[leaf] = best;
                        leaf_at[leaf] = best_at;
                    }
                }
                double best = -2.0;
                int best_at = -1;
                for (int leaf = group * 64; leaf < group * 64 + 64; ++leaf)
                    keep_better(best, best_at, leaf_far[leaf], leaf_at[leaf]);
                group_far[group] = best;
                group_at[group] = best_at;
            }
            for (int group = base; group < base + 8; ++group)
                keep_better(far, at, group_far[group], group_at[group]);
        }
        current = at;
    }
#endif
"""


@wp.func_native(GREEDY)
def take_farthest(
    cloud: SampledCloud, start: wp.array(dtype=wp.int32), count: wp.int32, out_index: wp.array(dtype=wp.int32)
): ...


@wp.kernel
def gather_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    scale: wp.float64,
    start: wp.int32,
    cloud: SampledCloud,
    out_start: wp.array(dtype=wp.int32),
):
    """Scaled points in order, padding behind the last, and where the first point to be taken has come to be."""
    i = first + wp.tid()
    p = wp.vec3d()
    squared = wp.float64(-1.0)
    index = NOBODY
    if i < points.shape[0]:
        index = order[i]
        p = points[index] * scale
        squared = wp.float64(wp.inf)
        if index == start:
            out_start[0] = i
    cloud.x[i] = p[0]
    cloud.y[i] = p[1]
    cloud.z[i] = p[2]
    cloud.squared[i] = squared
    cloud.index[i] = index


@wp.func
def put_box(box: wp.array(dtype=wp.float64), count: wp.int32, i: wp.int32, lower: wp.vec3d, upper: wp.vec3d):
    for axis in range(3):
        box[axis * count + i] = lower[axis]
        box[(3 + axis) * count + i] = upper[axis]


@wp.kernel
def leaf_box_kernel(first: int, cloud: SampledCloud, point_count: wp.int32):
    """Box of each leaf; one without points is infinitely far from everything and has nothing to give."""
    i = first + wp.tid()
    lower = wp.vec3d(wp.float64(wp.inf))
    upper = -lower
    far = wp.float64(-1.0)
    at = wp.int32(-1)
    for k in range(i * LEAF_POINTS, wp.min((i + 1) * LEAF_POINTS, point_count)):
        p = wp.vec3d(cloud.x[k], cloud.y[k], cloud.z[k])
        lower = wp.min(lower, p)
        upper = wp.max(upper, p)
        far = wp.float64(wp.inf)
        at = k
    put_box(cloud.leaf_box, cloud.group_count * GROUP_LEAVES, i, lower, upper)
    cloud.leaf_far[i] = far
    cloud.leaf_at[i] = at


@wp.kernel
def group_box_kernel(first: int, cloud: SampledCloud):
    """Box of each group of leaves."""
    i = first + wp.tid()
    count = cloud.group_count * GROUP_LEAVES
    lower = wp.vec3d(wp.float64(wp.inf))
    upper = -lower
    far = wp.float64(-1.0)
    at = wp.int32(-1)
    for k in range(i * GROUP_LEAVES, (i + 1) * GROUP_LEAVES):
        for axis in range(3):
            lower[axis] = wp.min(lower[axis], cloud.leaf_box[axis * count + k])
            upper[axis] = wp.max(upper[axis], cloud.leaf_box[(3 + axis) * count + k])
        if cloud.leaf_at[k] >= 0:
            far = wp.float64(wp.inf)
            at = cloud.leaf_at[k]
    put_box(cloud.group_box, cloud.group_count, i, lower, upper)
    cloud.group_far[i] = far
    cloud.group_at[i] = at


@wp.kernel
def greedy_kernel(
    first: int,
    cloud: SampledCloud,
    start: wp.array(dtype=wp.int32),
    count: wp.int32,
    out_index: wp.array(dtype=wp.int32),
):
    """Takes ``count`` points; all threads of the one block that there is take part in every step."""
    take_farthest(cloud, start, count, out_index)


@wp.kernel
def take_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32),
    out_points: wp.array(dtype=wp.vec3d),
):
    i = first + wp.tid()
    out_points[i] = points[index[i]]
