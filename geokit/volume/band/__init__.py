"""Narrow bands: which voxels lie near a mesh or balls, and what are their signed distances?"""
