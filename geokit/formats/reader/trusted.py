"""Reads sound files with other libraries in this process: without limits, and a crash ends the caller's program.

The twin of process.py, with the same answers and errors for whatever raises an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.errors import FileAccessError, FileFormatError, MissingDependencyError
from geokit.formats.file_content.body import Body


def read_mesh(
    path: Path, module: ModuleType, folders: Sequence[Path] | None, options: Mapping[str, float] | None = None
) -> list[Body]:
    """Run ``read_mesh`` of a module.

    Args:
        path: The file.
        module: The module that reads it.
        folders: Folders of referenced files besides the file's own; None if the module takes none.
        options: As for :func:`geokit.formats.reader.process.read_mesh`.
    Raises:
        FileAccessError: The file refers to one outside these folders.
        FileFormatError: The reader rejected the file.
        MissingDependencyError: The reader's library is not installed.
    """
    allowed = () if folders is None else (folders,)
    bodies = _read(path, lambda real: module.read_mesh(real, *allowed, **(options or {})))
    return [
        body._replace(
            points=np.asarray(body.points).reshape(-1, 3),
            counts=np.asarray(body.counts),
            indices=np.asarray(body.indices).ravel(),
            transform=None if body.transform is None else np.asarray(body.transform, np.float64),
        )
        for body in bodies
    ]


def read_points(path: Path, module: ModuleType) -> tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]]:
    """Run ``read_points`` of a module; raises what :func:`read_mesh` does."""
    found: tuple[NDArray[np.float64], dict[str, NDArray[np.generic]]] = _read(path, module.read_points)
    return found


def _read(path: Path, read: Callable[[Path], Any]) -> Any:
    # Relative references are relative to the file itself, not to a link to it.
    real = path.resolve()
    try:
        return read(real)
    except (FileFormatError, FileAccessError) as error:
        raise type(error)(f"{path}: {str(error).removeprefix(f'{real}: ')}") from None
    except ImportError as error:
        raise MissingDependencyError(str(error)) from None
    except (MemoryError, Warning):
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise FileFormatError(
            f"{path}: cannot be read ({reason}); the file is damaged or not what its name says"
        ) from error
