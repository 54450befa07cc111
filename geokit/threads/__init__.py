"""Runs the user's own kernels on all threads of a CPU, where warp alone uses one thread per launch."""

import lazy_loader

# __init__.pyi lists the public names by task; each is imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
