// Which children are those of a part of a node.
//
// Expects item, parts, first_child. Defines child and end.

const int node = item / parts, part = item % parts;
const int begin = first_child.data[node], count = first_child.data[node + 1] - begin;
int child = begin + (int)((long long)count * part / parts);
const int end = begin + (int)((long long)count * (part + 1) / parts);
