"""From a volume to a mesh: crossed cells, surface nets, marching cubes, dual contouring."""
