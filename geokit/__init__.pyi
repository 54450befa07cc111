__version__: str

# Meshes, volumes, point sets; figures; threads for kernels of one's own; accuracy against speed.
from . import mesh as mesh, points as points, volume as volume
from . import accuracy as accuracy, render as render, threads as threads

# What geokit raises on purpose.
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
