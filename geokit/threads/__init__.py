"""All threads of a CPU for the user's own kernels; warp runs a CPU launch on one thread."""

import lazy_loader

# The public names stand in __init__.pyi, by task; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
