"""Atomic file writes, and checks of file names and formats."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from geokit.errors import FileAccessError, InputError

__all__ = ["atomic_path", "extension", "require_extension", "require_file"]


def extension(path: str | os.PathLike[str]) -> str:
    """Lower-case extension of ``path`` with its dot; ``""`` if it has none."""
    return Path(path).suffix.lower()


def require_extension(path: str | os.PathLike[str], known: tuple[str, ...] | frozenset[str], what: str) -> str:
    """Return the extension of ``path``, which must be one of ``known``.

    Raises:
        InputError: The extension is not among ``known``; the message lists them.
    """
    found = extension(path)
    if found not in known:
        raise InputError(
            f"{Path(path)}: '{found or 'no extension'}' is not a {what} format; use one of {', '.join(sorted(known))}"
        )
    return found


def require_file(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a Path, which must name an existing, readable file.

    Raises:
        FileAccessError: The file is missing, a directory, or not readable.
    """
    path = Path(path)
    if not path.exists():
        raise FileAccessError(f"{path}: no such file; check the path")
    if path.is_dir():
        raise FileAccessError(f"{path}: is a directory; name a file in it")
    if not os.access(path, os.R_OK):
        raise FileAccessError(f"{path}: not readable; check its permissions")
    return path


@contextlib.contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path beside ``target`` that replaces it if the block succeeds.

    The temporary file has the target's extension, because some writers choose a format by name. It is fsynced
    and renamed over the target on success and removed on failure: a reader sees the old file or the new one.

    Raises:
        FileAccessError: The target's folder is missing or not writable, or the target is a directory.
    """
    target = Path(target)
    folder = target.parent
    if not folder.is_dir():
        raise FileAccessError(f"{target}: the folder {folder} does not exist; create it first")
    if target.is_dir():
        raise FileAccessError(f"{target}: is a directory; name a file in it")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=folder)
    except OSError as error:
        raise FileAccessError(f"{target}: cannot write there ({error.strerror}); choose another folder") from error
    os.close(handle)
    part = Path(name)
    try:
        yield part
        _publish(part, target)
    except OSError as error:
        if isinstance(error, FileAccessError):
            raise
        raise FileAccessError(f"{target}: writing failed ({error.strerror or error}); check the disk") from error
    finally:
        part.unlink(missing_ok=True)


def _publish(part: Path, target: Path) -> None:
    # mkstemp creates files with mode 0600. A new file gets the mode that umask allows, a replaced one keeps its mode.
    mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
    os.chmod(part, mode)
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, target)
    # The rename is durable only once the folder is synced. Some systems cannot open a folder.
    with contextlib.suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
