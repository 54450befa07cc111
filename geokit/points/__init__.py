"""Point sets: neighbors, normals, subsets, clusters, registration, and reading and writing point files."""

import lazy_loader

# The public names stand in __init__.pyi, by task; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
