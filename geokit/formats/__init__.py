"""Readers and writers of mesh and point files, one file a format, listed in table.py. Volumes are read elsewhere."""
