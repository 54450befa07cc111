"""Rays through volumes: traversal of cells, first crossings, integrals along rays."""
