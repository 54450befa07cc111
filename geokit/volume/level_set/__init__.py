"""Level sets: what are the distances in a new band, and which voxels are active after a dilation or an erosion?"""
