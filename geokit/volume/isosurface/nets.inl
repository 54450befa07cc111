// The fields of nets under the names that the other files use.
//
// Expects nets. Defines table, flips, records and base.

const auto& table = nets.table;
const auto &flips = nets.flips, &records = nets.records;
const auto& base = nets.base;
