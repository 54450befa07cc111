"""Distance fields of meshes, of one voxel size or several, and the choice between them."""
