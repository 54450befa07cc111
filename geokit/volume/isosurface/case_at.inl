// The case of a cell: the bit mask of its inside corners.
//
// Expects sheet_cases.inl, cells, plane, bit. Returns it.

u64 c[8];
cell_corners(cells.crossed.data[plane >> 3], plane & 7, inside_plane, c);
return case_of(c, bit);
