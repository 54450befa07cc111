"""Algorithms on point clouds and their kernels: normals, density, clusters, subsets, registration."""
