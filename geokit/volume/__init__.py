"""Sparse volumes: files, sampling, ray casting, conversion to and from level sets, and operations on them."""

import lazy_loader

# The public names are listed in __init__.pyi, by task. Each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
