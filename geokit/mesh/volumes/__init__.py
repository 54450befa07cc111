"""Meshes from volumes, and values of volumes at vertices."""
