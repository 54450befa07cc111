"""Accuracy and speed of geokit's methods on the user's own data, and the limits beyond which they fail."""

import lazy_loader

# The public names are listed by task in __init__.pyi; each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
