// Macros that find the leaf or tile of a voxel through a LeafTable. Undefined by whoever includes this file.
//
// Look-ups use index coordinates relative to the table's box. An entry >= 0 is a leaf; an entry < 0 is the
// complement of the place of a tile's value.
#define UPPER_OF(x, y, z) (((x) >> 7) * size_y + ((y) >> 7)) * size_z + ((z) >> 7)
#define SLOT_OF(x, y, z) ((((x) >> 3) & 15) << 8 | (((y) >> 3) & 15) << 4 | (((z) >> 3) & 15))
// Defines the members of a table that look-ups read.
#define TREE_OF(table)                                                                                                 \
    const int* const top = (table).top.data;                                                                           \
    const int* const slots = (table).slots.data;                                                                       \
    const int size_y = (table).size[1], size_z = (table).size[2];
// Defines `entry`, the entry of a voxel.
#define FIND_ENTRY(x, y, z)                                                                                            \
    const int start = top[UPPER_OF(x, y, z)];                                                                          \
    const int entry = start < 0 ? start : slots[start + SLOT_OF(x, y, z)];
