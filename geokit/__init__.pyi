__version__: str

# Meshes, volumes, point sets; figures; CPU threads for the user's own kernels; charts of accuracy against speed.
from . import mesh as mesh, points as points, volume as volume
from . import accuracy as accuracy, render as render, threads as threads

# Queries that the user's own kernels call.
from . import kernels as kernels

# Meshes whose vertices are a torch tensor; queries take tensors with gradients as they are.
from . import torch as torch

# Meshes and volumes of jax arrays.
from . import jax as jax

# Queries of dask arrays.
from . import distributed as distributed

# Idle memory, given back.
from .core.release import release_memory as release_memory

# Volumes as files of trimesh and meshio, and accessors of PyVista; only on this request.
from .plugins._register import register as register

# Small files to try things with.
from ._shipped import sample_path as sample_path

# Versions and build facts.
from ._config import show_config as show_config

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
    WorkerError as WorkerError,
)
