// The first crossing of the trilinear interpolant with an isovalue along a ray.
#include "volume/rays/crossing.inl"
#include "volume/rays/traverse.inl"
#include "volume/rays/traverse_blocks.inl"

static constexpr auto first_crossing = [](const RayField& field, const IndexRay& given, double isovalue, auto below,
                                          auto above) -> wp::vec4d {
    typedef decltype(below + below) real;
    auto in = opened(field.volume, field.anchor, real());
    Ray ray = into_box(field.lower, field.upper, given.start, given.toward, given.t_first, given.t_last);
    Crossing found;
    auto on_cell = [&](const real* c, bool mixed) {
        return crosses_cell(ray, c, mixed, isovalue, below, above, found,
                            [](const Cubic&, const Bracket&) { return false; });
    };
    auto on_unseen = [&]() { found.side = 0; };
    bool done = begin_search(ray, in.background, below, above, found);
    if (!done && field.reach.shape[0] != 0)
        done = traverse_blocks(
            field, ray, -2, [&](const address* block) { return pass_block(in, block, ray, on_unseen, on_cell); },
            on_unseen);
    else if (!done)
        done = traverse(
            in, ray, [&](real one, real other) { return side_of(one, below, above) == side_of(other, below, above); },
            [&](real value) {
                const int now = side_of(value, below, above);
                if (now == 0 || (now != 2 && now * found.side < 0)) {
                    found.hit = ray.t0 + ray.ta;
                    return true;
                }
                found.side = now == 2 ? 0 : now;
                return false;
            },
            on_cell);
    if (!done) end_search(ray, in.background, below, above, found);
    return wp::vec4d(found.hit, found.slope[0], found.slope[1], found.slope[2]);
};
