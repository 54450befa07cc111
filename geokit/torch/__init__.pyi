# Meshes whose vertices are a tensor.
from ._surface import Surface as Surface, sample_surface as sample_surface
