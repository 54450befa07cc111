"""NeighborGrid: points that are sorted once and asked for their neighbors often."""
