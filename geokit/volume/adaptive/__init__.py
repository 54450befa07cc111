"""Which cells of a distance field need finer voxels, and how fields of several voxel sizes are built and sampled."""
