"""Kernels and parts of what is made of point clouds: normals, density, subsets, registration."""
