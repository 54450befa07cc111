"""Kernels compiled ahead of their first use: which processors they are for, and the objects that a wheel brings."""
