"""Trees of grids as arrays of leaves, nodes and tiles; building, clipping, pruning and converting grids."""
