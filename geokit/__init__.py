"""Geometry on sparse volumes and meshes: closest points, rays, signed distance fields and neighbors."""

import lazy_loader

__version__ = "0.1.0"

# __init__.pyi lists the public names; each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*__all__, "__version__"]
