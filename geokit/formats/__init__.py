"""Readers and writers of mesh and point files, one file a format. Volumes are read by volume/nanovdb and native."""
