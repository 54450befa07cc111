// Merges clusters of triangles into the nodes of a tree: see bvh2_cuda_kernels.
//
// On CUDA the LANES threads of a block do it in shared memory; on a CPU, for tests, one.
#include "core/atomic.inl"
#include "core/parts.inl"

#if defined(__CUDA_ARCH__)
static constexpr auto wait_for_all = [] { __syncthreads(); };
#else
static constexpr auto wait_for_all = [] {};
#endif

// Local boxes of clusters, one axis after the other, lower corners first; their nodes, and the levels below those.
struct Chunk {
    float side[6][CHUNK];
    int node[CHUNK], levels[CHUNK];
};
static constexpr auto copy_cluster = [](const Chunk& from, int i, Chunk& to, int j) {
    for (int k = 0; k < 6; ++k) to.side[k][j] = from.side[k][i];
    to.node[j] = from.node[i];
    to.levels[j] = from.levels[i];
};
// Half the area of the box around two clusters.
static constexpr auto joint_area = [](const Chunk& c, int i, int j) {
    float size[3];
    for (int k = 0; k < 3; ++k)
        size[k] = wp::max(c.side[3 + k][i], c.side[3 + k][j]) - wp::min(c.side[k][i], c.side[k][j]);
    return size[0] * size[1] + size[1] * size[2] + size[2] * size[0];
};

// The CHUNK clusters from a place on, of parts of `clusters` that begin CHUNK apart: the numbers of those before each
// part are `offsets`. Merges them until a quarter is left, or one if they are all that there are.
static constexpr auto merge_chunk = [](int item, const auto& clusters, const wp::array_t<int>& offsets, int most_levels,
                                       wp::array_t<int>& made, wp::array_t<wp::vec3>& boxes,
                                       wp::array_t<wp::vec4i>& links, wp::array_t<int>& parent, auto& out_clusters,
                                       wp::array_t<int>& out_count) {
#if defined(__CUDA_ARCH__)
    constexpr int LANES = THREADS;
    __shared__ Chunk chunks[2];
    __shared__ int partner[CHUNK], sums[LANES], first_node;
#else
    constexpr int LANES = 1;
    Chunk chunks[2];
    int partner[CHUNK], sums[LANES], first_node;
#endif
    constexpr int SHARE = CHUNK / LANES;
    const int lane = item % LANES, place = item / LANES * CHUNK;
    const int total = offsets.data[offsets.shape[0] - 1], triangles = links.shape[0] + 1;
    int count = wp::min(CHUNK, total - place), now = 0;
    const int target = total <= CHUNK ? 1 : (count + 3) / 4;
    for (int i = lane; i < count; i += LANES) {
        const int part = part_of(offsets, place + i);
        const auto c = clusters.data[CHUNK * part + place + i - offsets.data[part]];
        for (int k = 0; k < 3; ++k) {
            chunks[0].side[k][i] = c.lower[k];
            chunks[0].side[3 + k][i] = c.upper[k];
        }
        chunks[0].node[i] = c.node;
        chunks[0].levels[i] = c.levels;
    }
    // Where few clusters are each other's best partner, or branches are long, neighbors merge.
    bool in_pairs = false;
    while (count > target) {
        const Chunk& from = chunks[now];
        Chunk& to = chunks[1 - now];
        wait_for_all();
        for (int i = lane; i < count; i += LANES) {
            int best = in_pairs && (i ^ 1) < count ? i ^ 1 : i;
            float least = INFINITY;
            const int end = in_pairs ? 0 : i + REACH < count ? i + REACH + 1 : count;
            for (int j = i < REACH ? 0 : i - REACH; j < end; ++j) {
                if (j == i || wp::max(from.levels[i], from.levels[j]) >= most_levels) continue;
                const float area = joint_area(from, i, j);
                // Of equal areas the partner counts whose place differs in lower bits: of equal ones, pairs merge.
                if (!(area < least || (area == least && (i ^ j) < (i ^ best)))) continue;
                least = area;
                best = j;
            }
            partner[i] = best;
        }
        wait_for_all();
        // A cluster leads a merge (LEADS) or stays alone (1); it goes into one before it (0).
        constexpr int LEADS = CHUNK * 2 + 1;
        auto role_of = [&](int i) {
            const int j = partner[i];
            return j == i || partner[j] != i ? 1 : i < j ? LEADS : 0;
        };
        const int begin = lane * SHARE, end = wp::min(begin + SHARE, count);
        int own = 0;
        for (int i = begin; i < end; ++i) own += role_of(i);
        sums[lane] = own;
        wait_for_all();
        int before = 0, all = 0;
        for (int other = 0; other < LANES; ++other) {
            if (other == lane) before = all;
            all += sums[other];
        }
        const int left = all % (2 * CHUNK), merges = all / (2 * CHUNK);
        if (lane == 0 && merges > 0) first_node = add_to(made, 0, merges);
        wait_for_all();
        for (int i = begin; i < end; ++i) {
            const int role = role_of(i), j = partner[i], row = before % (2 * CHUNK);
            const int node = first_node + before / (2 * CHUNK);
            before += role;
            if (role == 1) copy_cluster(from, i, to, row);
            if (role != LEADS) continue;
            int below[2];
            for (int side = 0; side < 2; ++side) {
                const int at = side ? j : i, child = from.node[at];
                for (int k = 0; k < 3; ++k) {
                    boxes.data[4 * node + 2 * side][k] = from.side[k][at];
                    boxes.data[4 * node + 2 * side + 1][k] = from.side[3 + k][at];
                }
                below[side] = child < 0 ? 1 : links.data[child][2] + links.data[child][3];
                parent.data[child < 0 ? triangles - 1 - child : child] = 2 * node + side;
            }
            links.data[node] = wp::vec4i(from.node[i], from.node[j], below[0], below[1]);
            for (int k = 0; k < 3; ++k) {
                to.side[k][row] = wp::min(from.side[k][i], from.side[k][j]);
                to.side[3 + k][row] = wp::max(from.side[3 + k][i], from.side[3 + k][j]);
            }
            to.node[row] = node;
            to.levels[row] = wp::max(from.levels[i], from.levels[j]) + 1;
        }
        in_pairs = merges * 32 < count;
        count = left;
        now = 1 - now;
    }
    wait_for_all();
    for (int i = lane; i < count; i += LANES) {
        const Chunk& c = chunks[now];
        auto& out = out_clusters.data[place + i];
        for (int k = 0; k < 3; ++k) {
            out.lower[k] = c.side[k][i];
            out.upper[k] = c.side[3 + k][i];
        }
        out.node = c.node[i];
        out.levels = c.levels[i];
    }
    if (lane == 0) out_count.data[place / CHUNK] = count;
};

// Where a triangle (the item from `nodes` on) or a node is, by the nodes above it: the first slot, and for nodes the
// number by which they stand before all below them, those of the left child first.
static constexpr auto place_of = [](int item, const wp::array_t<wp::vec4i>& links, const wp::array_t<int>& parent) {
    const int root = links.shape[0] - 1;
    wp::vec2i place(0, 0);
    for (int at = item; at != root && links.shape[0] > 0;) {
        const int up = parent.data[at] >> 1, left = links.data[up][2], is_right = parent.data[at] & 1;
        place[0] += is_right ? left : 0;
        place[1] += is_right ? left : 1;
        at = up;
    }
    return place;
};
