"""Queries of a prepared surface: closest points, rays, overlaps, intersections, distances between surfaces."""
