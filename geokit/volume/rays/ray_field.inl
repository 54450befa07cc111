// The members of a RayField as local names.
//
// Expects field. Defines volume, anchor, lower, upper, reach, numbers, first_block, block_count and blocks.
const unsigned long long volume = field.volume;
const auto& anchor = field.anchor;
const auto& lower = field.lower;
const auto& upper = field.upper;
const auto& reach = field.reach;
const auto& numbers = field.numbers;
const auto& first_block = field.first_block;
const auto& block_count = field.block_count;
const auto& blocks = field.blocks;
