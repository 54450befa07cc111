"""Bounding volume hierarchies and their traversal: eight children per node on a CPU (bvh8), two on CUDA (bvh2)."""
