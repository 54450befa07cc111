"""Meshes of any library, prepared for queries: one surface, or many in one call."""
