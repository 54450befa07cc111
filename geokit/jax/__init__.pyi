# Meshes whose vertices are an array of jax, and volumes whose active values are one.
from ._surface import Surface as Surface
from ._volume import Volume as Volume, with_values as with_values
