"""Trees of grids as arrays: leaves, nodes and tiles; how grids are built from them, cut and converted."""
