"""Closed bodies that touch, overlap or lie within each other: the boundary of their union."""
