"""From a mesh or balls to a narrow band: tiles near the surface, distances, signs."""
