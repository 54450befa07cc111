"""Folders for temporary files that vanish with their process, even if it is killed.

Each folder holds a locked file. The system frees the lock when the process ends, however it ends, so whoever needs a
folder at the same place next finds those without an owner and removes them.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import re
import secrets
import stat
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from geokit.core.base.interrupts import ATTEMPTS
from geokit.errors import FileAccessError, InputError

try:
    import fcntl
except ImportError:  # not a POSIX system: what killed processes leave stays
    fcntl = None  # type: ignore[assignment]

PREFIX = ".geokit-"
# A machine and a number: other folders of the user may begin like that, such as those of a batch.
OWN_NAME = re.compile(re.escape(PREFIX) + "[0-9a-f]{8}-[0-9a-f]{16}")
LOCK = "lock"
OTHERS = stat.S_IWGRP | stat.S_IWOTH
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
    """
    parent = Path(parent)
    _remove_abandoned(parent)
    made: list[_Made] = []
    try:
        yield _make(parent, made)
    finally:
        # Ctrl-C may come at any call, also in here. Then removing starts again, and the interrupt goes on afterwards.
        interrupt, left = None, ATTEMPTS
        while left:
            try:
                _remove(made)
                left = 0
            except BaseException as error:
                interrupt, left = error, left - 1
        try:
            if interrupt is not None:
                raise interrupt
        finally:
            del interrupt  # its traceback holds this frame


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


class _Made:
    """A folder from before it is there: an interrupt may come before its maker is told that it is."""

    def __init__(self, parent: Path) -> None:
        self.path = parent / f"{PREFIX}{_machine()}-{secrets.token_hex(8)}"
        self.lock: io.FileIO | None = None


def _make(parent: Path, made: list[_Made]) -> Path:
    while True:
        one = _Made(parent)
        made.append(one)
        os.mkdir(one.path, 0o700)
        if fcntl is None:
            return one.path
        try:
            # An object that closes itself: a number would be lost with an interrupt, and the lock kept.
            one.lock = io.FileIO(one.path / LOCK, "ab")
        except FileNotFoundError:
            if parent.is_dir():
                continue  # another process has taken the folder for an abandoned one, before it was locked
            raise
        with contextlib.suppress(OSError):
            fcntl.flock(one.lock, fcntl.LOCK_EX)
        with contextlib.suppress(OSError):
            if os.path.samestat(os.stat(one.path / LOCK), os.fstat(one.lock.fileno())):
                return one.path


def _remove(made: list[_Made]) -> None:
    for one in made:
        remove_folder(one.path)
        if one.lock is not None:
            one.lock.close()


def remove_folder(folder: str | os.PathLike[str]) -> None:
    """Remove what can be removed of a folder, or a link in its place.

    A lock goes last: a private folder without one would never be removed if this process is killed meanwhile.
    shutil.rmtree() may close a descriptor twice where an interrupt comes.
    """
    if os.path.islink(folder):
        with contextlib.suppress(OSError):
            os.unlink(folder)
        return
    for place, folders, files in os.walk(folder, topdown=False):
        for name in sorted((*files, *folders), key=LOCK.__eq__):
            path = os.path.join(place, name)
            with contextlib.suppress(OSError):
                (os.rmdir if name in folders and not os.path.islink(path) else os.unlink)(path)
    with contextlib.suppress(OSError):
        os.rmdir(folder)


def make_own(folder: Path) -> None:
    """Make a folder for this user alone, or see that what is there is one that nobody else could have filled.

    Raises:
        InputError: There is a link, a file, a folder of another user, or one that others may write to.
        OSError: It cannot be made.
    """
    try:
        os.mkdir(folder, 0o700)
    except FileExistsError:  # else nothing is asked: some file systems give all that is made another owner or mode
        found = os.lstat(folder)
        reason = "is a link" if stat.S_ISLNK(found.st_mode) else "is no folder"
        _require(folder, distrust(folder, found) if stat.S_ISDIR(found.st_mode) else reason)


def require_trusted(path: Path) -> None:
    """See that nobody else could have put anything at a path: each folder and link on the way counts.

    Raises:
        InputError: Somebody could have. On the way, not at its end, the sticky bit makes a folder of all users safe.
        OSError: There is nothing at the path, or it cannot be looked at.
    """
    end, ways = os.stat(path), [path.absolute()]
    for way in ways:  # what links lead to is added
        for place in (way, *way.parents):
            found = os.lstat(place)
            is_safe = found.st_mode & stat.S_ISVTX and not os.path.samestat(found, end)
            if stat.S_ISLNK(found.st_mode):
                ways.append(place.parent / os.readlink(place))
                is_safe = True
            _require(place, distrust(place, found, 0 if is_safe else OTHERS))


def distrust(place: Path, found: os.stat_result, bits: int = OTHERS) -> str:
    """Why somebody else than this user and root could have filled a folder or written a file; "" if nobody could."""
    if not hasattr(os, "geteuid"):  # permissions lie elsewhere than in these numbers
        return ""
    # Whoever owns the top folder is root, also in a container that shows root by another number.
    if found.st_uid not in (os.geteuid(), os.stat("/").st_uid):
        return "belongs to another user"
    writers = found.st_mode & bits
    return "may be written by other users" if writers and not (writers == 0o020 and _is_alone(place, found)) else ""


def _is_alone(place: Path, found: os.stat_result) -> bool:
    """Whether the group is the owner's alone: where each user has one of the same name, folders let it write."""
    with contextlib.suppress(OSError, AttributeError):  # there is no access control list, or no such thing
        os.getxattr(place, "system.posix_acl_access")
        return False  # the bits of the group are then what anyone in the list may have
    import grp
    import pwd

    with contextlib.suppress(KeyError):
        owner, group = pwd.getpwuid(found.st_uid).pw_name, grp.getgrgid(found.st_gid)
        return group.gr_name == owner and {*group.gr_mem} <= {owner}
    return False


def _require(place: Path, reason: str) -> None:
    if reason:
        raise InputError(f"{place}: {reason}, so what is in it is not trusted; remove it, or choose another folder")


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _remove_abandoned(parent: Path) -> None:
    key = str(parent)
    if fcntl is None or time.monotonic() < _next_look.get(key, 0.0):
        return
    started = time.thread_time()
    with contextlib.suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if OWN_NAME.fullmatch(entry.name):
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
    try:
        lock = os.open(os.path.join(entry.path, LOCK), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        os.rmdir(entry.path)  # of a process that was killed before its lock was there, or after; no other is empty
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if stat.S_ISREG((held := os.fstat(lock)).st_mode) and not held.st_size:
            remove_folder(entry.path)
    finally:
        os.close(lock)
