"""Triangle meshes: files, audit and repair, simplification, queries, sampling, distances between them."""

import lazy_loader

# The public names stand in __init__.pyi, by task; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
