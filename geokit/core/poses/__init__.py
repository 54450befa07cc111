"""Queries of bodies that a rigid map has moved."""
