"""Kinds of files by name and content, and the check before one is replaced."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from geokit.core.files import extension, require_file
from geokit.errors import InputError
from geokit.formats.table import FORMATS, module_of

if TYPE_CHECKING:
    from geokit.volume._model import SparseVolume

__all__ = ["Kind", "kind_of_input", "kind_of_output", "load_grid", "may_write"]

Kind = Literal["mesh", "volume", "cloud"]

# Headers of .ply end within this; the counts in a .vtp stand in its first element.
_HEAD_BYTES = 1 << 16


def kind_of_input(path: Path) -> Kind:
    """Return the kind of an existing file; .ply and .vtp files without faces are point clouds.

    Raises:
        FileAccessError: The file is missing or unreadable.
        InputError: The extension is unknown.
    """
    require_file(path)
    kind = _kind_of_extension(path)
    return "cloud" if kind == "mesh" and _lacks_faces(path) else kind


def kind_of_output(path: Path) -> Kind:
    """Return the kind of file that a name stands for.

    Raises:
        InputError: The extension is unknown.
    """
    return _kind_of_extension(path)


def _kind_of_extension(path: Path) -> Kind:
    kind = extension(path)
    if kind not in FORMATS:
        listed = ", ".join(sorted(FORMATS))
        raise InputError(f"{path}: '{kind or 'no extension'}' is not a known format; use one of {listed}")
    found = FORMATS[kind]
    return "mesh" if found.mesh else "volume" if found.volume else "cloud"


def _lacks_faces(path: Path) -> bool:
    """Whether a file that may be a mesh or a cloud announces no faces; False where that cannot be told."""
    kind = extension(path)
    if not FORMATS[kind].points:
        return False
    lacks_faces = getattr(module_of(kind), "lacks_faces", None)
    if lacks_faces is None:
        return False
    with open(path, "rb") as file:
        return bool(lacks_faces(file.read(_HEAD_BYTES)))


def may_write(path: Path, *, force: bool) -> None:
    """Check that a file may be written.

    Raises:
        InputError: The file exists and ``force`` is not given.
    """
    if path.exists() and not force:
        raise InputError(f"{path}: exists already; add --force to replace it")


def load_grid(path: Path, name: str | None) -> "SparseVolume":
    """Load the grid called ``name``, or the only grid of the file.

    Raises:
        InputError: No grid has that name, or no name was given and there are several grids.
    """
    from geokit.volume import load

    try:
        return load(path, grid=name)
    except InputError as error:
        # The library's message names its parameter; the user knows the option.
        raise InputError(str(error).replace("with grid=", "with --grid")) from error
