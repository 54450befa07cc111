"""Mesh topology: connectivity, orientation, measures of faces, merged vertices."""
