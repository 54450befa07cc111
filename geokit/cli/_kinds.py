"""Kinds of files by name and content, and the check before one is replaced."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from geokit.core.files import extension, require_file
from geokit.errors import InputError

if TYPE_CHECKING:
    from geokit.volume._model import SparseVolume

__all__ = [
    "CLOUD_EXTENSIONS",
    "MESH_EXTENSIONS",
    "VOLUME_EXTENSIONS",
    "Kind",
    "kind_of_input",
    "kind_of_output",
    "load_grid",
    "may_write",
]

Kind = Literal["mesh", "volume", "cloud"]

VOLUME_EXTENSIONS = frozenset({".vdb", ".nvdb"})
MESH_EXTENSIONS = frozenset(
    {
        ".obj",
        ".ply",
        ".stl",
        ".off",
        ".glb",
        ".gltf",
        ".3mf",
        ".vtk",
        ".vtp",
        ".vtu",
        ".msh",
        ".xdmf",
        ".usd",
        ".usda",
        ".usdc",
        ".usdz",
    }
)
CLOUD_EXTENSIONS = frozenset({".csv", ".txt", ".xyz", ".npy", ".npz", ".pcd", ".pts", ".las", ".laz"})

# The header of a .ply, and the first element of a .vtp with its counts, are within this many bytes.
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
    found = extension(path)
    for kind, known in (("mesh", MESH_EXTENSIONS), ("volume", VOLUME_EXTENSIONS), ("cloud", CLOUD_EXTENSIONS)):
        if found in known:
            return kind  # type: ignore[return-value]
    listed = ", ".join(sorted(MESH_EXTENSIONS | VOLUME_EXTENSIONS | CLOUD_EXTENSIONS))
    raise InputError(f"{path}: '{found or 'no extension'}' is not a known format; use one of {listed}")


def _lacks_faces(path: Path) -> bool:
    """Whether the header of a .ply or .vtp declares no faces; False if that cannot be determined."""
    found = extension(path)
    if found not in (".ply", ".vtp"):
        return False
    with open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
    if found == ".ply":
        header = head.partition(b"end_header")[0]
        faces = re.search(rb"^element\s+face\s+(\d+)", header, re.MULTILINE)
        return header.startswith(b"ply") and (faces is None or int(faces[1]) == 0)
    counts = re.findall(rb"NumberOf(?:Polys|Strips)\s*=\s*\"\s*(\d+)\s*\"", head)
    return bool(counts) and all(int(count) == 0 for count in counts)


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
