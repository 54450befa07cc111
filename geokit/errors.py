"""Exceptions that geokit raises on purpose.

    Exception
    └── GeokitError
        ├── InputError (ValueError)             a value, shape, index or option that cannot be used
        ├── FileAccessError (OSError)           a file that is missing, unreadable or unwritable
        ├── FileFormatError                     a file whose content is damaged or not what its name says
        ├── UnsupportedGridError                a grid type, class or transform that geokit cannot represent
        ├── MissingDependencyError (ImportError) an optional part that is not installed
        └── DeviceMemoryError (MemoryError)     a request that needs more memory than there is

A message says what was wrong, where (file, argument, first bad row) and what to do about it.
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
]


class GeokitError(Exception):
    """Root of every exception that geokit raises on purpose."""


class InputError(GeokitError, ValueError):
    """An argument that cannot be used: wrong shape, non-finite value, index out of range, unknown option."""


class FileAccessError(GeokitError, OSError):
    """A file that does not exist, cannot be read, or cannot be written."""

    # OSError formats itself from errno; geokit's own sentence is the better message.
    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class FileFormatError(GeokitError):
    """A file whose content is damaged, truncated, or not what its name says."""


class UnsupportedGridError(GeokitError):
    """A grid type, grid class or transform that geokit cannot represent."""


class MissingDependencyError(GeokitError, ImportError):
    """An optional part of geokit that is not installed; the message names the packages."""


class DeviceMemoryError(GeokitError, MemoryError):
    """A request that needs more memory than the device has; the message says what would fit."""
