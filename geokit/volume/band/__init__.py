"""Which voxels lie in a narrow band around a mesh or balls, and what their signed distances are."""
