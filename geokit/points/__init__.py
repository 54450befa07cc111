"""Point clouds: neighbor searches, normals, subsets, clusters, registration, and point files."""

import lazy_loader

# The public names are listed by task in __init__.pyi; each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
