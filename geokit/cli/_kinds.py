"""What a file holds, and whether one may be written."""

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
    """What an existing file holds; .ply and .vtp without faces are point clouds.

    Raises:
        FileAccessError: The file is missing or unreadable.
        InputError: The extension is unknown.
    """
    require_file(path)
    kind = _kind_of_extension(path)
    return "cloud" if kind == "mesh" and _lacks_faces(path) else kind


def kind_of_output(path: Path) -> Kind:
    """What a file of that name will hold.

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
    """Refuse to replace a file that was not meant to be replaced.

    Raises:
        InputError: The file exists and ``force`` is not given.
    """
    if path.exists() and not force:
        raise InputError(f"{path}: exists already; add --force to replace it")


def load_grid(path: Path, name: str | None) -> "SparseVolume":
    """The grid called ``name``, or the only one.

    Raises:
        InputError: There are several and none was named, or there is none of that name.
    """
    from geokit.volume import load

    try:
        return load(path, grid=name)
    except InputError as error:
        # The library's words name its own parameter.
        raise InputError(str(error).replace("with grid=", "with --grid")) from error
