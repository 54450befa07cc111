"""Which value and which derivatives a volume has at a point, by the nearest voxel or an interpolant of order 1 to 3."""
