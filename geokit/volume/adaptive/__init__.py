"""Adaptive fields: which cells need finer voxels, and how are fields of several voxel sizes built and sampled?"""
