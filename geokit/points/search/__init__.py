"""Neighbor searches: points sorted by cell, and a tree for the nearest k."""
