// Parts of one array after each other: see scan_kernels.
#pragma once

static constexpr auto part_of = [](const wp::array_t<int>& offsets, int item) -> int {
    return wp::lower_bound(offsets, item + 1) - 1;
};
