"""Files that other files refer to are opened only in the folder of the first, and in folders that the caller allows."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path

from geokit.errors import FileAccessError

# Most characters of a reference in a message.
LONGEST = 100

_default: tuple[Path, ...] = ()


def set_default_folders(folders: Sequence[Path]) -> None:
    """Set the folders that are allowed where none are given."""
    global _default
    _default = tuple(folders)


def allowed_folders(folders: Sequence[str | os.PathLike[str]] | None) -> tuple[Path, ...]:
    """Folders as they are, without symbolic links; the default ones for None.

    Raises:
        InputError: It is no list of paths.
        FileAccessError: One is no folder.
    """
    from geokit.core.require import require_items, require_path

    found = []
    for number, given in enumerate(_default if folders is None else require_items(folders, "reference_folders")):
        folder = require_path(given, f"reference_folders[{number}]")
        if not folder.is_dir():
            raise FileAccessError(f"reference_folders: {folder} is not a folder; name existing ones")
        found.append(Path(os.path.realpath(folder)))
    return tuple(found)


def require_inside(reference: str, target: Path, path: Path, folders: Sequence[Path]) -> Path:
    """The regular file that a reference leads to, without symbolic links; it may be missing.

    Args:
        reference: The reference as it stands in the file, for the message.
        target: The file that it names.
        path: The file that the caller named; its folder is allowed.
        folders: Further folders that are allowed.
    Raises:
        FileAccessError: It lies in none of these folders, or is a FIFO or a device.
    """
    if "\0" in str(target):
        raise FileAccessError(
            f"{path}: refers to {reference[:LONGEST]!r}, which is no file name; correct the reference"
        )
    real = Path(os.path.realpath(target))
    if not any(real.is_relative_to(os.path.realpath(folder)) for folder in (path.parent, *folders)):
        raise FileAccessError(
            f"{path}: refers to {reference[:LONGEST]!r} ({real}), outside its own folder; if you trust the file, "
            f"allow the folder with reference_folders=[{str(real.parent)!r}] (--reference-folder)"
        )
    if os.path.exists(real) and not stat.S_ISREG(real.stat().st_mode):
        raise FileAccessError(
            f"{path}: refers to {reference[:LONGEST]!r}, which is not a regular file; correct the reference"
        )
    return real
