"""Neighbor searches: points sorted by cell for radius searches, and a tree for the k nearest points."""
