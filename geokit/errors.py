"""The exceptions of geokit::

    Exception
    └── GeokitError
        ├── InputError (ValueError)             an unusable value, shape, index or option
        ├── FileAccessError (OSError)           a missing, unreadable or unwritable file
        ├── FileFormatError                     a file with damaged content, or with other content than its name says
        ├── UnsupportedGridError                a grid type, class or transform without support in geokit
        ├── MissingDependencyError (ImportError) an optional part of geokit that is not installed
        ├── DeviceMemoryError (MemoryError)     a request that exceeds the available memory
        └── WorkerError (RuntimeError)          a process that reads files did not start, or was killed from outside

Each message says what was wrong, where (file, argument, first bad row) and what to do about it.
"""

from __future__ import annotations

__all__ = [
    "DeviceMemoryError",
    "FileAccessError",
    "FileFormatError",
    "GeokitError",
    "InputError",
    "MissingDependencyError",
    "UnsupportedGridError",
    "WorkerError",
]


# What is said of needs beyond counting [bytes].
LARGEST_NEED = 2**63


class GeokitError(Exception):
    """Base class of all exceptions that geokit raises on purpose."""


class InputError(GeokitError, ValueError):
    """An unusable argument: wrong shape, non-finite value, index out of range, unknown option."""


class FileAccessError(GeokitError, OSError):
    """A file that does not exist, cannot be read, or cannot be written."""

    # OSError builds its text from errno; geokit's message says more.
    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class FileFormatError(GeokitError):
    """A file with damaged or truncated content, or with other content than its name says."""


class UnsupportedGridError(GeokitError):
    """A grid type, grid class or transform that geokit cannot represent."""


class MissingDependencyError(GeokitError, ImportError):
    """An optional part of geokit that is not installed; the message names the packages."""


class DeviceMemoryError(GeokitError, MemoryError):
    """A request that exceeds the memory of the device; the message says what would fit.

    Attributes:
        need: Estimate of what the operation needs [bytes]; 0 where it cannot be known.
    """

    # MemoryError's refuses a class that has another base before it. Dask's pickles call it by name.
    __new__ = Exception.__new__  # type: ignore[assignment]

    def __init__(self, message: str = "", *, need: float = 0) -> None:
        super().__init__(message)
        self.need = int(need) if need < LARGEST_NEED else LARGEST_NEED


class WorkerError(GeokitError, RuntimeError):
    """A process that reads files did not start, or was killed from outside; the file is not to blame."""
