"""Accuracy against speed: geokit's methods measured on the user's own data, and where they fail."""

import lazy_loader

# The public names stand in __init__.pyi, by task; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
