"""Connected components: which voxels hang together over faces, and a volume for each component."""
