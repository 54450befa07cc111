"""The OpenVDB bridge: reads and writes .vdb files as NanoVDB buffers, and converts between volumes and meshes.

The extension exists if geokit was built with OpenVDB. Without it, ``available()`` is False and every other function
raises ``MissingDependencyError``.

By default a separate worker process reads files: OpenVDB crashes on damaged files, and then only the worker crashes.
"""

import lazy_loader

# __init__.pyi lists the public names; each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
