__version__: str

# Meshes, volumes, point sets; figures; CPU threads for the user's own kernels; charts of accuracy against speed.
from . import mesh as mesh, points as points, volume as volume
from . import accuracy as accuracy, render as render, threads as threads

# Exceptions.
from . import errors as errors
from .errors import (
    DeviceMemoryError as DeviceMemoryError,
    FileAccessError as FileAccessError,
    FileFormatError as FileFormatError,
    GeokitError as GeokitError,
    InputError as InputError,
    MissingDependencyError as MissingDependencyError,
    UnsupportedGridError as UnsupportedGridError,
)
