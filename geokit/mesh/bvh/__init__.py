"""Bounding volume hierarchies: eight children a node on a CPU (bvh8), two on CUDA (bvh2), and how queries walk them."""
