"""Objects of geokit's kernels for GPUs, and a table of them."""
