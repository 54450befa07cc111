"""Which mesh represents an isosurface of a volume: crossed cells, surface nets, marching cubes, dual contouring."""
