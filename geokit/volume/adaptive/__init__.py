"""Distance fields of several voxel sizes."""
