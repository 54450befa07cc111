"""Readers and writers of mesh and point files, one file per format, listed in table.py. Volumes are read elsewhere."""
