// Validation of NanoVDB grids: a grid that check_nanovdb accepts can be walked to its last voxel inside its bytes.
#include "../../../geokit/native/src/bridge.h"
#include "../../../geokit/native/src/nano_types.h"

#include "exact.h"

#include <algorithm>
#include <cstring>
#include <random>

extern "C" size_t LLVMFuzzerMutate(uint8_t* data, size_t size, size_t max_size);

namespace {

// Tiles as OpenVDB's conversion takes them: all slots without a child.
template<typename Node, typename ValueT>
size_t tiles_equal(const Node& node, const ValueT& background)
{
    size_t equal = 0;
    for (auto it = node.childMask().beginOff(); it; ++it) equal += (node.data()->mTable[*it].value == background);
    return equal;
}

// What OpenVDB's conversion and NanoVDB's readers follow: children, tiles, masks and values of every node.
template<typename BuildT>
void walk(const nanovdb::NanoGrid<BuildT>& grid)
{
    const auto& root = grid.tree().root();
    size_t active = grid.tree().isActive(nanovdb::Coord(1, 2, 3));
    for (auto upper = root.beginChild(); upper; ++upper) {
        active += tiles_equal(*upper, root.background());
        for (auto lower = upper->beginChild(); lower; ++lower) {
            active += tiles_equal(*lower, root.background());
            for (auto leaf = lower->beginChild(); leaf; ++leaf) {
                for (uint32_t i = 0; i < 512; ++i) active += (leaf->getValue(i) == root.background());
                const auto voxel = leaf->origin();
                active += grid.tree().isActive(voxel) + (grid.tree().getValue(voxel) == root.background());
            }
        }
    }
    static volatile size_t kept;
    kept = active + std::strlen(grid.gridName());
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size)
{
    const Exact bytes(data, size, NANOVDB_DATA_ALIGNMENT);
    try {
        geokit::check_nanovdb(bytes.data(), size);
    } catch (const geokit::BridgeError&) {
        return 0;
    }
    const auto* grid = reinterpret_cast<const nanovdb::GridData*>(bytes.data());
    geokit::dispatch(grid->mGridType, [&](auto tag) {
        walk(*reinterpret_cast<const nanovdb::NanoGrid<typename decltype(tag)::Type>*>(bytes.data()));
    });
    return 0;
}

// Most bytes of a grid are zeros and background: changes go to the headers, and to words that are not their neighbors.
extern "C" size_t LLVMFuzzerCustomMutator(uint8_t* data, size_t size, size_t max_size, unsigned seed)
{
    if (size < 1024 || seed % 16 == 0) return LLVMFuzzerMutate(data, size, max_size);
    std::minstd_rand random(seed);
    const auto below = [&](size_t n) { return size_t(random()) % n; };
    const auto word_at = [&](size_t at) {
        uint64_t word;
        std::memcpy(&word, data + at, sizeof word);
        return word;
    };
    for (size_t left = 1 + below(3); left; --left) {
        size_t at = below(2) ? below(1000) & ~size_t(7) : 0;
        for (int tries = 0; !at && tries < 4096; ++tries) {
            const size_t found = (8 + below(size - 16)) & ~size_t(7);
            if (word_at(found) != word_at(found - 8)) at = found;
        }
        const uint64_t extremes[] = {0, 1, ~0ull, 1ull << 63, 1ull << 31, 0xffffffffull, size, size - 32, 32, 96};
        uint64_t word = word_at(at);
        switch (below(5)) {
        case 0: word ^= 1ull << below(64); break;
        case 1: word = extremes[below(10)]; break;
        case 2: word += (below(2) ? 1 : -1) * (1ull << below(20)); break;
        case 3: word = word_at(below(size - 8) & ~size_t(7)); break;
        default: LLVMFuzzerMutate(data + at, 8, 8); continue;
        }
        std::memcpy(data + at, &word, sizeof word);
    }
    return size;
}
