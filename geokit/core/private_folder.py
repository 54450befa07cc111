"""Folders for temporary files that vanish with their process, even if it is killed.

Each folder holds a locked file. The system frees the lock when the process ends, however it ends, so whoever needs a
folder at the same place next finds those without an owner and removes them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from geokit.errors import FileAccessError

__all__ = ["private_folder", "temporary_parent"]

PREFIX = ".geokit-"
LOCK = "lock"
# One part in this many of the time may be spent looking for abandoned folders, because folders of many files take long.
# It is measured as time of the processor, so that a slow disk does not postpone the next look.
LOOKING_SHARE = 20
# On a shared file system, locks of other machines may be invisible. Their folders count as abandoned after this time.
FOREIGN_SECONDS = 24 * 3600.0

# When to look again, by parent folder.
_next_look: dict[str, float] = {}
_REMEMBERED = 1000


@contextlib.contextmanager
def private_folder(parent: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a new folder in ``parent`` that only this user can enter, and remove it with its content afterwards.

    Folders that killed processes have left in ``parent`` are removed first. Where the file system has no locks, they
    stay.

    Raises:
        OSError: ``parent`` cannot be written.

    Held by: tests/core/test_private_folder.py
    """
    parent = Path(parent)
    _remove_abandoned(parent)
    folder, lock = _made(parent)
    try:
        yield folder
    finally:
        try:
            os.unlink(folder / LOCK)
            os.rmdir(folder)
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def temporary_parent() -> str:
    """The system's folder for temporary files.

    Raises:
        FileAccessError: None can be written to.
    """
    try:
        return tempfile.gettempdir()
    except FileNotFoundError as error:
        raise FileAccessError(
            f"temporary files: {error.strerror}; free some room, or name a folder in the variable TMPDIR"
        ) from None


def _made(parent: Path) -> tuple[Path, int]:
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{_machine()}-", dir=parent))
        try:
            lock = _open_lock(folder)
        except FileNotFoundError:
            if parent.is_dir():
                continue  # another process has taken the folder for an abandoned one, before it was locked
            raise
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        with contextlib.suppress(OSError):
            if os.path.samestat(os.stat(folder / LOCK), os.fstat(lock)):
                return folder, lock
        os.close(lock)


def _open_lock(folder: str | os.PathLike[str]) -> int:
    return os.open(os.path.join(folder, LOCK), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def _machine() -> str:
    return f"{zlib.crc32(os.uname().nodename.encode()):08x}"


def _remove_abandoned(parent: Path) -> None:
    key = str(parent)
    if time.monotonic() < _next_look.get(key, 0.0):
        return
    started = time.thread_time()
    with contextlib.suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if entry.name.startswith(PREFIX):
                with contextlib.suppress(OSError):
                    _remove_if_abandoned(entry)
    if len(_next_look) >= _REMEMBERED:
        _next_look.clear()
    _next_look[key] = time.monotonic() + LOOKING_SHARE * (time.thread_time() - started)


def _remove_if_abandoned(entry: os.DirEntry[str]) -> None:
    found = entry.stat(follow_symlinks=False)
    if not entry.is_dir(follow_symlinks=False) or found.st_uid != os.geteuid():
        return
    if not entry.name.startswith(f"{PREFIX}{_machine()}-"):
        newest = max([found.st_mtime, *(file.stat(follow_symlinks=False).st_mtime for file in os.scandir(entry.path))])
        if time.time() - newest < FOREIGN_SECONDS:
            return
    lock = _open_lock(entry.path)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(entry.path, ignore_errors=True)
    finally:
        os.close(lock)
