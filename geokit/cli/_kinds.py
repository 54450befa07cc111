"""What a file holds, and whether one may be written."""

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
    found = extension(path)
    for kind, known in (("mesh", MESH_EXTENSIONS), ("volume", VOLUME_EXTENSIONS), ("cloud", CLOUD_EXTENSIONS)):
        if found in known:
            return kind  # type: ignore[return-value]
    listed = ", ".join(sorted(MESH_EXTENSIONS | VOLUME_EXTENSIONS | CLOUD_EXTENSIONS))
    raise InputError(f"{path}: '{found or 'no extension'}' is not a known format; use one of {listed}")


def _lacks_faces(path: Path) -> bool:
    """Whether the header of a .ply or .vtp announces no faces; False where that cannot be told."""
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
