# Meshes whose vertices are an array of jax, and volumes whose active values are one.
from ._traced import Surface as Surface, Volume as Volume, with_values as with_values
