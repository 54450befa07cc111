// Which children, or parts of them, make up a node.
//
// Expects node, parts, first_child. Defines child and end.

int child = parts ? node * parts : first_child.data[node];
const int end = parts ? child + parts : first_child.data[node + 1];
