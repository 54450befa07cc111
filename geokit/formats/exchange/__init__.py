"""Scenes of other programs, through the libraries of their formats: COLLADA, FBX, CAD."""
