"""Atomic file writes, checks of file names and formats, and names for what readers make of damaged files."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from geokit.core.base.interrupts import ATTEMPTS
from geokit.core.base.printable import in_one_line
from geokit.core.base.private_folder import private_folder
from geokit.core.require import require_path
from geokit.errors import FileAccessError, FileFormatError, GeokitError, InputError

# Extensions with two dots.
_DOUBLE = (".nii.gz",)
_KINDS = {
    stat.S_IFDIR: "directory",
    stat.S_IFIFO: "FIFO",
    stat.S_IFCHR: "character device",
    stat.S_IFBLK: "block device",
    stat.S_IFSOCK: "socket",
}
# The first line of what a clone has in place of a large file.
_POINTER = b"version https://git-lfs"
# Longer extensions, which no format has, are left off the name of the temporary file.
LONGEST_SUFFIX = 32
# Most characters of a message about a file, which may quote all of it, and of its end, which says what to do.
LONGEST, REMEDY = 2000, 300


def extension(path: str | os.PathLike[str]) -> str:
    """Lower-case extension of ``path`` with its dot, both of ``.nii.gz``; ``""`` if it has none."""
    name = require_path(path).name.lower()
    return next((kind for kind in _DOUBLE if name.endswith(kind) and name != kind), require_path(path).suffix.lower())


def require_extension(path: str | os.PathLike[str], known: tuple[str, ...] | frozenset[str], what: str) -> str:
    """Return the extension of ``path``, which must be one of ``known``.

    Raises:
        InputError: The extension is not among ``known``; the message lists them.
    """
    found = extension(path)
    if found not in known:
        found, listed = found or "no extension", ", ".join(sorted(known))
        raise InputError(f"{require_path(path)}: '{found}' is not a {what} format; use one of {listed}")
    return found


def require_file(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a Path, which must name an existing, readable, regular file.

    FIFOs and devices are refused without opening them, because that may block or act on the device.

    Raises:
        FileAccessError: The file is missing, not a regular file, or not readable.
        FileFormatError: It is a pointer of Git LFS, which stands in a clone for a file that was not fetched.
    """
    path = require_path(path)
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileAccessError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise FileAccessError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if not stat.S_ISREG(found.st_mode):
        raise FileAccessError(_irregular(path, found))
    if not os.access(path, os.R_OK):
        raise FileAccessError(f"{path}: not readable; check its permissions")
    refuse_pointer(path)
    return path


def refuse_pointer(path: Path) -> None:
    """Refuse a pointer of Git LFS.

    Raises:
        FileFormatError: The file is one.
    """
    with contextlib.suppress(OSError), open(path, "rb") as file:
        if file.read(len(_POINTER)) == _POINTER:
            raise FileFormatError(f"{path}: is a Git LFS pointer, not the file itself; get it with: git lfs pull")


def refuse_empty(path: Path) -> None:
    """Refuse a file of no bytes.

    Raises:
        FileFormatError: The file is empty.
    """
    if path.stat().st_size == 0:
        raise FileFormatError(f"{path}: is empty; get a whole copy")


def size_of(path: Path) -> int:
    """Size of a file, or of all files in a folder."""
    if not path.is_dir():
        return path.stat().st_size
    return sum(one.stat().st_size for one in path.rglob("*") if one.is_file())


def require_room(target: Path, need: float, what: str, remedy: str) -> None:
    """Check that the disk of ``target`` has room for ``need`` bytes.

    Raises:
        FileAccessError: It has not; the message says what needs them, and what to do.
    """
    try:
        free = shutil.disk_usage(target.parent).free
    except OSError:  # of a folder that is missing, which is named where the file is made
        return
    if need > free:
        raise FileAccessError(
            f"{target}: {what} need {need / 2**30:.3g} GiB or more of the {free / 2**30:.3g} GiB that are free there; "
            f"{remedy}"
        )


def is_there(path: Path) -> bool:
    """Whether there is a file or a folder of that name.

    Raises:
        FileAccessError: The system has no such names, for example since the name is too long.
    """
    try:
        return path.exists()
    except (OSError, ValueError) as error:  # a name that is too long, or that no encoding of the system knows
        reason = getattr(error, "strerror", None) or error
        raise FileAccessError(f"{path!r}: no file can have that name ({reason}); check the path") from error


@contextlib.contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path that replaces ``target`` if the block succeeds.

    The temporary file lies in a private folder beside the target and has the target's extension, because some writers
    choose a format by name. It is fsynced and renamed over the target on success and removed on failure: a reader sees
    the old file or the new one. If the process is killed, the next call for that folder removes the temporary file.

    Symbolic links are followed: the file that they lead to is replaced. A file that is replaced keeps its permissions,
    and its owner where the system allows that. A file with several names (hard links) keeps them, and is overwritten
    from the finished temporary file: the room is reserved first, so a full disk leaves the old content, but a reader
    may see a mixture meanwhile.

    Raises:
        FileAccessError: The target's folder is missing or not writable, the target is a directory, a FIFO or a device,
            or writing failed.
    """
    target = require_path(target)
    with folder_beside(_followed(target)[0], target) as folder:
        suffix = target.name[-size:] if 0 < (size := len(extension(target))) <= LONGEST_SUFFIX else ""
        part = folder / f"part{suffix}"
        # Created here, so that umask and the folder's rules give a new file its mode.
        with io.FileIO(part, "xb") as file:
            mode = os.fstat(file.fileno()).st_mode
        yield part
        _publish(part, mode, target)


@contextlib.contextmanager
def folder_beside(real: Path, target: Path) -> Iterator[Path]:
    """A private folder beside a file; errors name the target that leads to it.

    Raises:
        FileAccessError: The file's folder is missing or not writable, or writing failed.
    """
    if not real.parent.is_dir():
        raise FileAccessError(f"{target}: the folder {real.parent} does not exist; create it first")
    folder = None
    try:
        with private_folder(real.parent) as folder:
            yield folder
    except OSError as error:
        if isinstance(error, FileAccessError):
            raise
        if folder is None:
            raise FileAccessError(f"{target}: cannot write there ({error.strerror}); choose another folder") from error
        raise FileAccessError(f"{target}: writing failed ({error.strerror or error}); check the disk") from error


def _followed(target: Path) -> tuple[Path, os.stat_result | None]:
    """The file that symbolic links lead to, and what stands there now.

    Raises:
        FileAccessError: Something that is not a regular file stands there, or a link leads nowhere.
    """
    found = None
    try:
        with contextlib.suppress(FileNotFoundError):
            found = target.stat()
        real = Path(os.path.realpath(target))
    except OSError as error:
        raise FileAccessError(f"{target}: cannot write there ({error.strerror}); choose another name") from error
    if found is not None and not stat.S_ISREG(found.st_mode):
        raise FileAccessError(_irregular(target, found))
    # Links of /proc to open files lead to files that may have lost their name.
    if found is not None and not (real.exists() and os.path.samestat(real.stat(), found)):
        raise FileAccessError(f"{target}: leads to a file that has no name; name a file in a folder")
    return real, found


def _irregular(path: Path, found: os.stat_result) -> str:
    kind = _KINDS.get(stat.S_IFMT(found.st_mode), "special file")
    if kind == "directory":
        return f"{path}: is a directory; name a file in it"
    return f"{path}: is a {kind}; name a regular file"


def _publish(part: Path, mode: int, target: Path) -> None:
    # What stands at the target is looked at again, because writing may have taken long.
    real, found = _followed(target)
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    if found is not None and found.st_nlink > 1:
        _copy_over(part, real)
        return
    if found is not None:
        mode = found.st_mode
        # Only root may give files away; others may choose among their groups.
        for owner in ((-1, found.st_gid), (found.st_uid, -1)):
            with contextlib.suppress(OSError, AttributeError):  # or nobody may, on systems that are not POSIX
                os.chown(part, *owner)
    os.chmod(part, mode & 0o777)
    os.replace(part, real)
    # The rename is durable only once the folder is synced.
    with contextlib.suppress(OSError):
        sync(real.parent)


def sync(path: Path) -> None:
    """Have the system put a file or a folder on its disk; Windows cannot open a folder."""
    with contextlib.suppress(PermissionError):
        descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _copy_over(part: Path, real: Path) -> None:
    interrupt = None
    for _ in range(ATTEMPTS):
        try:
            _copy(part, real)
            break
        # Half of a file is none: copying starts again, and the interrupt goes on afterwards.
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt


def _copy(part: Path, real: Path) -> None:
    with open(part, "rb") as source, open(real, "rb+") as file:
        before, after = os.fstat(file.fileno()).st_size, os.fstat(source.fileno()).st_size
        if after > before and hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(file.fileno(), before, after - before)
            except OSError:
                file.truncate(before)
                raise
        shutil.copyfileobj(source, file, 1 << 20)
        file.truncate(after)
        file.flush()
        os.fsync(file.fileno())


def damaged(path: Path | str, why: str) -> FileFormatError:
    """The error of a file whose content is wrong, which its program may write again."""
    return FileFormatError(f"{path}: {why}; the file is damaged, export it again")


@contextlib.contextmanager
def named_damage(path: Path) -> Iterator[None]:
    """Context in which a file is read: NumPy says nothing of bytes that are no numbers, and errors are named.

    Messages are one line of printable text, whatever bytes of the file they quote.

    Args:
        path: The file.
    Raises:
        FileFormatError: The code inside raises anything else than a GeokitError, a MemoryError, or a warning that
            the caller has made an error.
    """
    try:
        # Casts of signaling NaN warn; what is not finite is found and named after reading.
        with np.errstate(invalid="ignore", over="ignore"):
            yield
    except GeokitError as error:
        # Names of columns, elements and layers are the file's.
        said = str(error.args[0]) if error.args else ""
        start = str(path) if said.startswith(str(path)) else ""
        told = said[len(start) :]
        if len(told) > LONGEST:
            told = f"{told[: LONGEST - REMEDY]} ... {told[-REMEDY:]}"
        if start + told != said or not told.isprintable():
            error.args = (start + in_one_line(told, None), *error.args[1:])
        raise
    except (MemoryError, Warning):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {in_one_line(str(error))}"
        kind = f" as {path.suffix.lower()}" if path.suffix else ""  # folders and slices of DICOM have none
        raise damaged(path, f"cannot be read{kind} ({reason})") from error
