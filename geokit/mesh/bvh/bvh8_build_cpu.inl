// Builds the CPU tree: a range of references is split in two by a binned surface area heuristic, and a node is formed
// by splitting its largest range again until it has eight.
//
// A reference is one vector of eight: lower x y z, triangle, then the negatives of upper x y z and of the area. So the
// bounds of many are the least of each lane.
#include "core/parts.inl"
#include "core/simd.inl"

// A way to split a range: its axis, the first bin of the right part, and the costs, which count blocks of a leaf.
struct Plane {
    int axis, bin;
    float cost;
    v4 factor;
};
struct Range {
    int begin, end;
    v8 box;      // as a reference, with the largest area of one
    v8 centers;  // lower bounds of twice the centers, then the negatives of the upper ones
    Plane plane;
};
// What a build works on: references, and a byte for each.
struct Build {
    v8* data;
    wp::uint8* sides;
};
// Instead of an axis: there is no plane; it was not looked for.
static constexpr int NONE = -1, UNKNOWN = -2;
static constexpr float HUGE_BOX = 3e38f;
// More than the area of any local box.
static constexpr float LEAF_RANK = 100.f;
static constexpr auto least = [](const v8& a, const v8& b) { return a < b ? a : b; };
static constexpr auto center = [](const v8& r) -> v4 { return r.lo - r.hi; };
static constexpr auto area = [](const v8& box) {
    const v4 e = box.lo + box.hi;
    return e.x * e.y + e.y * e.z + e.z * e.x;
};
// Twice the center, and its negative.
static constexpr auto spread = [](const v8& r) -> v8 {
    const v4 c = center(r), d = -c;
    return __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
};
// Computes the bounds of a range from its references.
static constexpr auto bound = [](const Build& build, Range& range) {
    v8 box = HUGE_BOX, centers = HUGE_BOX;
    for (int i = range.begin; i < range.end; ++i) {
        const v8 r = build.data[i];
        box = least(box, r);
        centers = least(centers, spread(r));
    }
    range.box = box;
    range.centers = centers;
    range.plane = {UNKNOWN};
};
static constexpr auto blocks = [](int n) { return (n + 7) >> 3; };
// The areas of four boxes, from the sums of the two corners of each.
static constexpr auto area_four = [](const v4* e) -> v4 {
    const v4 xy = __builtin_shufflevector(e[0], e[1], 0, 4, 1, 5), rs = __builtin_shufflevector(e[2], e[3], 0, 4, 1, 5);
    const v4 zw = __builtin_shufflevector(e[0], e[1], 2, 6, 3, 7), tw = __builtin_shufflevector(e[2], e[3], 2, 6, 3, 7);
    const v4 x = __builtin_shufflevector(xy, rs, 0, 1, 4, 5), y = __builtin_shufflevector(xy, rs, 2, 3, 6, 7);
    const v4 z = __builtin_shufflevector(zw, tw, 0, 1, 4, 5);
    return x * y + y * z + z * x;
};
// Numbers of bins. In a large range references that follow each other go to different sets: neighbors mostly meet in a
// bin, which would wait for the one before.
struct FewBins {
    enum { COUNT = BINS / 2, SETS = 1 };
};
struct ManyBins {
    enum { COUNT = BINS, SETS = 1 };
};
struct ManySets {
    enum { COUNT = BINS, SETS = 4 };
};
// The cheapest plane between bins, for those references of a range that count.
static constexpr auto cheapest_of = [](const v8* data, const Range& range, auto number, auto counts) {
    constexpr int COUNT = decltype(number)::COUNT, SETS = decltype(number)::SETS;
    const v4 low = range.centers.lo, extent = -range.centers.hi - low;
    Plane plane = {NONE, 0, HUGE_BOX, 0.f};
    v4& factor = plane.factor;
    for (int k = 0; k < 3; ++k) factor[k] = extent[k] > 1e-30f ? COUNT * 0.9999f / extent[k] : 0.f;
    if (!(factor.x > 0.f || factor.y > 0.f || factor.z > 0.f)) return plane;
    v8 bins[SETS][3][COUNT];
    int counted[SETS][3][COUNT];
    for (int set = 0; set < SETS; ++set)
        for (int k = 0; k < 3; ++k)
            for (int b = 0; b < COUNT; ++b) {
                bins[set][k][b] = HUGE_BOX;
                counted[set][k][b] = 0;
            }
    auto put = [&](int i, int set) {
        const v8 r = data[i];
        if (!counts(r)) return;
        const i4 at = __builtin_convertvector((center(r) - low) * factor, i4);
        for (int k = 0; k < 3; ++k) {
            const int b = at[k];
            bins[set][k][b] = least(bins[set][k][b], r);
            ++counted[set][k][b];
        }
    };
    int next = range.begin;
    for (; next + SETS <= range.end; next += SETS)
        for (int set = 0; set < SETS; ++set) put(next + set, set);
    for (; next < range.end; ++next) put(next, 0);
    auto& bin = bins[0];
    auto& filled = counted[0];
    for (int set = 1; set < SETS; ++set)
        for (int k = 0; k < 3; ++k)
            for (int b = 0; b < COUNT; ++b) {
                bin[k][b] = least(bin[k][b], bins[set][k][b]);
                filled[k][b] += counted[set][k][b];
            }
    for (int k = 0; k < 3; ++k) {
        if (factor[k] == 0.f) continue;
        // Of the boxes to the left and to the right of each plane: sums of their corners, and counts.
        v4 left[COUNT], right[COUNT];
        int before[COUNT], after[COUNT], n = 0;
        v8 box = HUGE_BOX;
        for (int b = COUNT - 1; b >= 0; --b) {
            box = least(box, bin[k][b]);
            right[b] = box.lo + box.hi;
            after[b] = n += filled[k][b];
        }
        box = HUGE_BOX;
        n = 0;
        for (int b = 0; b < COUNT; ++b) {
            left[b] = box.lo + box.hi;
            before[b] = n;
            box = least(box, bin[k][b]);
            n += filled[k][b];
        }
        for (int b = 0; b < COUNT; b += 4) {
            const i4 p = *(const i4*)(before + b), q = *(const i4*)(after + b);
            const v4 few = __builtin_convertvector((p + 7) >> 3, v4), rest = __builtin_convertvector((q + 7) >> 3, v4);
            const v4 other = area_four(right + b) * rest;
            const v4 whole = other + area_four(left + b) * few;
            const v4 cost = ((p > 0) & (q > 0)) ? whole : HUGE_BOX;
            v4 lowest = cost < cost.zwxy ? cost : cost.zwxy;
            lowest = lowest < lowest.yxwz ? lowest : lowest.yxwz;
            const bool better = lowest.x < plane.cost;
            plane.bin = better ? b + __builtin_ctz(mask_of_four(cost == lowest)) : plane.bin;
            plane.axis = better ? k : plane.axis;
            plane.cost = better ? lowest.x : plane.cost;
        }
    }
    return plane;
};
static constexpr auto cheapest = [](const v8* data, const Range& range, auto counts) {
    const int count = range.end - range.begin;
    return count < 64          ? cheapest_of(data, range, FewBins(), counts)
           : count < SETS_FROM ? cheapest_of(data, range, ManyBins(), counts)
                               : cheapest_of(data, range, ManySets(), counts);
};
// Finds the plane of a range if it is not known.
static constexpr auto find_plane = [](const Build& build, Range& range) {
    if (range.plane.axis == UNKNOWN) range.plane = cheapest(build.data, range, [](const v8&) { return true; });
};
// Moves the references for which is_left(numbers of a reference) to the left part, without a branch that depends on
// them: their sides are written down, a block ahead at either end. After a reference for the left the next one comes
// from the front, after one for the right from the back, whose place it takes.
static constexpr auto part = [](const Build& build, const Range& range, Range& left, Range& right, auto is_left) {
    int i = range.begin, j = range.end - 1, from = i, front = i, back = j;
    auto look = [&](int first, int last) {
        for (int k = first; k <= last; ++k) build.sides[k] = is_left((const float*)(build.data + k));
    };
    const v8 huge = HUGE_BOX;
    v8 r = build.data[from], boxes_of[2] = {huge, huge}, centers_of[2] = {huge, huge};
    while (i <= j) {
        if (front <= i && front <= back) {
            const int last = front + AHEAD <= back ? front + AHEAD - 1 : back;
            look(front, last);
            front = last + 1;
        }
        if (back >= j && back >= front) {
            const int first = back - AHEAD >= front ? back - AHEAD + 1 : front;
            look(first, back);
            back = first - 1;
        }
        const int ahead = front - i < j - back ? front - i : j - back;
        for (int step = front > back ? j - i + 1 : ahead; step > 0; --step) {
            const int is = build.sides[from], place = is ? i : j;
            i += is;
            j += is - 1;
            from = is ? i : place;
            const v8 next = build.data[from];
            build.data[place] = r;
            const v8 both = spread(r);
            const i8 mask = -is;
            boxes_of[0] = least(boxes_of[0], mask ? r : huge);
            boxes_of[1] = least(boxes_of[1], mask ? huge : r);
            centers_of[0] = least(centers_of[0], mask ? both : huge);
            centers_of[1] = least(centers_of[1], mask ? huge : both);
            r = next;
        }
    }
    left = {range.begin, i, boxes_of[0], centers_of[0], {UNKNOWN}};
    right = {i, range.end, boxes_of[1], centers_of[1], {UNKNOWN}};
};
static constexpr auto part_at = [](const Build& build, const Range& range, Range& left, Range& right) {
    const Plane& plane = range.plane;
    const int k = plane.axis;
    const float low = range.centers[k], factor = plane.factor[k];
    part(build, range, left, right,
         [&](const float* r) { return (int)((r[k] - r[4 + k] - low) * factor) < plane.bin; });
};
// Cost of a range as one more split leaves it.
static constexpr auto cost_split = [](const Build& build, Range& range) {
    if (range.end - range.begin <= WIDTH) return area(range.box);
    find_plane(build, range);
    return range.plane.cost;
};
static constexpr auto cost_of = [](const v8& box, int count) { return area(box) * blocks(count); };
// Takes out the references that are larger than a share of the range's area, if that pays: they would widen the boxes
// of everything beside their centers, on all levels down to their leaf. Taken out they cost a leaf for each ray that
// meets the range, and the rest can be split well. Compared are three parts each: the large ones and a split rest, or
// a split range of which one part is split again. Where the range has a plane, it was split there into left and right.
static constexpr auto take_out = [](const Build& build, const Range& range, Range& left, Range& right) {
    const float whole = area(range.box);
    if (-range.box[7] <= 0.03125f * whole) return false;
    // Bounds and numbers of the references by size, in parts whose limits are 1/2, 1/8, 1/32 of the area.
    const v8 huge = HUGE_BOX;
    v8 box[4] = {huge, huge, huge, huge}, centers[4] = {huge, huge, huge, huge};
    int above[3] = {0, 0, 0};
    for (int i = range.begin; i < range.end; ++i) {
        const v8 r = build.data[i], both = spread(r);
        const float a = -r[7];
        if (__builtin_expect(a > 0.03125f * whole, 0)) {
            const bool half = a > 0.5f * whole, eighth = a > 0.125f * whole;
            above[0] += half;
            above[1] += eighth;
            ++above[2];
            const int size = 2 - half - eighth;
            box[size] = least(box[size], r);
            centers[size] = least(centers[size], both);
        } else {
            box[3] = least(box[3], r);
            centers[3] = least(centers[3], both);
        }
    }
    // Only outliers are taken out.
    const int count = range.end - range.begin, few = count / 8;
    bool possible = false;
    for (int n : above) possible |= n > 0 && n <= few;
    if (!possible) return false;
    float best = HUGE_BOX;
    if (range.plane.axis >= 0) {
        const float a = cost_of(left.box, left.end - left.begin), b = cost_of(right.box, right.end - right.begin);
        const float c = cost_split(build, left), d = cost_split(build, right);
        best = GAIN * (a + d < c + b ? a + d : c + b);
    }
    float best_share = 0.f, share = 0.5f;
    Plane plane;
    for (int s = 0; s < 3; ++s, share *= 0.25f) {
        if (above[s] == (s ? above[s - 1] : 0) || above[s] > few) continue;
        v8 large = huge;
        Range rest = range;
        rest.box = rest.centers = huge;
        for (int size = 0; size < 4; ++size)
            if (size <= s) large = least(large, box[size]);
            else {
                rest.box = least(rest.box, box[size]);
                rest.centers = least(rest.centers, centers[size]);
            }
        const float limit = share * whole;
        rest.plane = cheapest(build.data, rest, [&](const v8& r) { return -r[7] <= limit; });
        const float now = cost_of(large, above[s]) + rest.plane.cost;
        if (now < best) {
            best = now;
            best_share = share;
            plane = rest.plane;
        }
    }
    if (best_share == 0.f) return false;
    part(build, range, left, right, [&](const float* r) { return -r[7] > best_share * whole; });
    right.plane = plane;
    return true;
};
// Splits a range into two non-empty ones.
static constexpr auto split = [](const Build& build, Range& range, bool halve, Range& left, Range& right) {
    if (!halve) {
        find_plane(build, range);
        const bool is_split = range.plane.axis >= 0;
        if (is_split) part_at(build, range, left, right);
        if (range.end - range.begin >= TAKE_FROM && take_out(build, range, left, right)) return;
        if (is_split) return;
    }
    left.begin = range.begin;
    left.end = right.begin = range.begin + (range.end - range.begin) / 2;
    right.end = range.end;
    bound(build, left);
    bound(build, right);
};
// Splits a range into the children of one node; returns their number.
static constexpr auto open = [](const Build& build, const Range& range, bool halve, Range* child) {
    int count = 1;
    child[0] = range;
    while (count < WIDTH) {
        int largest = -1;
        float most = -1.f;
        for (int c = 0; c < count; ++c) {
            if (child[c].end - child[c].begin <= WIDTH) continue;
            const float a = area(child[c].box);
            if (a > most || largest < 0) {
                most = a;
                largest = c;
            }
        }
        if (largest < 0) break;
        Range whole = child[largest];
        split(build, whole, halve, child[largest], child[count]);
        ++count;
    }
    // Leaves last, and larger children behind smaller ones: rays that any hit ends visit them from the last one on.
    auto rank = [&](const Range& r) { return area(r.box) + (r.end - r.begin <= WIDTH ? LEAF_RANK : 0.f); };
    for (int c = 1; c < count; ++c) {
        const Range moved = child[c];
        int place = c;
        for (; place > 0 && rank(child[place - 1]) > rank(moved); --place) child[place] = child[place - 1];
        child[place] = moved;
    }
    return count;
};
static constexpr auto write = [](const wp::array_t<float>& boxes, int node, const Range* child, int count) {
    for (int c = 0; c < WIDTH; ++c)
        for (int k = 0; k < 3; ++k) {
            boxes.data[node * 48 + k * 8 + c] = c < count ? child[c].box[k] : HUGE_BOX;
            boxes.data[node * 48 + 24 + k * 8 + c] = c < count ? -child[c].box[4 + k] : -HUGE_BOX;
        }
};

// Writes the reference of triangle i: its local box, rounded outward, and its area.
static constexpr auto write_reference = [](int i, const wp::array_t<wp::vec3d>& vertices, const wp::array_t<int>& faces,
                                           const wp::array_t<int>& begin, const wp::array_t<wp::vec3d>& origins,
                                           const wp::array_t<double>& scales, wp::array_t<float>& out_references) {
    const int tree = part_of(begin, i);
    const wp::vec3d& origin = origins.data[tree];
    const double scale = scales.data[tree];
    const int* face = faces.data + (wp::int64)3 * i;
    auto corner = [&](int k) {
        const wp::vec3d& p = vertices.data[face[k]];
        return (d4){p[0] - origin[0], p[1] - origin[1], p[2] - origin[2], 0.0};
    };
    const d4 a = corner(0), b = corner(1), c = corner(2);
    auto lower_of = [](const d4& p, const d4& q) { return p < q ? p : q; };
    const d4 lower = lower_of(lower_of(a, b), c), upper = lower_of(lower_of(-a, -b), -c);
    d8 both = __builtin_shufflevector(lower, upper, 0, 1, 2, 3, 4, 5, 6, 7);
    both = both / scale;
    // Within a unit in the last place below the nearest float32; the product is rounded before it is subtracted.
    v8 box = __builtin_convertvector(both, v8);
    const v8 slack = 1.2e-7f * __builtin_elementwise_abs(box);
    box = box - slack - 1e-30f;
    const v4 e = box.lo + box.hi;
    box[3] = __builtin_bit_cast(float, i);
    box[7] = -(e.x * e.y + e.y * e.z + e.z * e.x);
    *(v8*)(out_references.data + (wp::int64)8 * i) = box;
};

// Builds the top of a tree of the references `begin` to `end` - 1: nodes are opened in the order of their numbers, from
// place `base` on, until their children hold at most `limit` references. Those children are left to build_subtree, as
// child number -1 - subtree.
static constexpr auto build_top =
    [](int tree, const wp::array_t<float>& references, const wp::array_t<wp::uint8>& sides,
       const wp::array_t<int>& begins, const wp::array_t<int>& bases, const wp::array_t<int>& limits,
       const wp::array_t<int>& scratch, wp::array_t<float>& boxes, wp::array_t<int>& children,
       wp::array_t<int>& out_subtree, wp::array_t<int>& out_size) {
        const int base = bases.data[tree], limit = limits.data[tree], capacity = bases.data[tree + 1] - base;
        const Build build = {(v8*)references.data, sides.data};
        Range root;
        root.begin = begins.data[tree];
        root.end = begins.data[tree + 1];
        bound(build, root);
        Range* waiting = (Range*)(scratch.data + (long long)WAITING_WORDS * base);
        int* depth = (int*)(waiting + capacity);
        int nodes = 1, subtrees = 0;
        waiting[0] = root;
        depth[0] = 0;
        for (int node = 0; node < nodes; ++node) {
            Range child[WIDTH];
            const int found = open(build, waiting[node], depth[node] >= HALVING_DEPTH, child);
            write(boxes, base + node, child, found);
            for (int c = 0; c < WIDTH; ++c) {
                int number = NO_CHILD;
                if (c < found && child[c].end - child[c].begin > limit && nodes < capacity) {
                    waiting[nodes] = child[c];
                    depth[nodes] = depth[node] + 1;
                    number = nodes++;
                } else if (c < found) {
                    int* row = out_subtree.data + 3 * (WIDTH * base + subtrees);
                    row[0] = child[c].begin;
                    row[1] = child[c].end;
                    row[2] = depth[node] + 1;
                    number = -1 - subtrees++;
                }
                children.data[(base + node) * WIDTH + c] = number;
            }
        }
        out_size.data[2 * tree] = nodes;
        out_size.data[2 * tree + 1] = subtrees;
    };

// Builds one subtree. Its nodes get numbers from node_base on, parents before children. Its leaves are written from
// position `begin` on, which has room for one leaf per reference.
static constexpr auto build_subtree = [](int subtree, const wp::array_t<float>& references,
                                         const wp::array_t<wp::uint8>& sides, const wp::array_t<int>& subtrees,
                                         const wp::array_t<int>& node_bases, wp::array_t<float>& boxes,
                                         wp::array_t<int>& children, wp::array_t<int>& leaf_begin,
                                         wp::array_t<int>& leaf_end, wp::array_t<int>& out_size) {
    const int* row = subtrees.data + 3 * subtree;
    const int begin = row[0], end = row[1], start_depth = row[2], node_base = node_bases.data[subtree];
    const Build build = {(v8*)references.data, sides.data};
    Range root;
    root.begin = begin;
    root.end = end;
    bound(build, root);
    int nodes = 0, leaves = 0;
    auto leaf = [&](const Range& r) {
        leaf_begin.data[begin + leaves] = r.begin;
        leaf_end.data[begin + leaves] = r.end;
        return -1 - leaves++;
    };
    if (end - begin <= WIDTH) leaf(root);
    else {
        Range waiting[STACK];
        int number[STACK], depth[STACK], height = 1;
        waiting[0] = root;
        number[0] = nodes++;
        depth[0] = start_depth;
        while (height > 0) {
            --height;
            const int node = number[height], level = depth[height];
            const Range range = waiting[height];
            Range child[WIDTH];
            const int found = open(build, range, level >= HALVING_DEPTH, child);
            write(boxes, node_base + node, child, found);
            for (int c = 0; c < WIDTH; ++c) {
                int value = NO_CHILD;
                if (c < found && child[c].end - child[c].begin <= WIDTH) value = leaf(child[c]);
                else if (c < found) {
                    waiting[height] = child[c];
                    depth[height] = level + 1;
                    number[height++] = value = nodes++;
                }
                children.data[(node_base + node) * WIDTH + c] = value;
            }
        }
    }
    out_size.data[2 * subtree] = nodes;
    out_size.data[2 * subtree + 1] = leaves;
};

// Recomputes the boxes of the nodes from those of the leaves' blocks. Children have larger numbers than their parents:
// from the last node to the first, everything below a node is done before it.
static constexpr auto refit_nodes = [](int, int count, const wp::array_t<int>& children,
                                       const wp::array_t<float>& block_boxes, wp::array_t<float>& boxes) {
    for (int node = count - 1; node >= 0; --node) {
        for (int c = 0; c < WIDTH; ++c) {
            const int child = children.data[WIDTH * node + c];
            if (child == NO_CHILD) continue;
            for (int k = 0; k < 6; ++k) {
                float side;
                if (child < 0) side = block_boxes.data[6 * (-1 - child) + k];
                else {
                    // Boxes of absent children are inverted, so that they widen nothing.
                    const float* row = boxes.data + 48 * child + 8 * k;
                    side = row[0];
                    for (int j = 1; j < WIDTH; ++j) side = k < 3 ? wp::min(side, row[j]) : wp::max(side, row[j]);
                }
                boxes.data[48 * node + 8 * k + c] = side;
            }
        }
    }
};
