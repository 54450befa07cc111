"""Files that a wheel has beside the modules, and a checkout elsewhere: samples and pages. Standard library only."""

from __future__ import annotations

from pathlib import Path

from geokit.errors import FileAccessError, InputError

# By the name within a wheel, as pyproject.toml packs them.
IN_CHECKOUT = {"docs": "docs", "guides": "docs/guides", "samples": "data/samples"}


def folder_of(kind: str) -> Path:
    """The folder of the guides, of the samples, or of the page on the command line."""
    package = Path(__file__).resolve().parent
    for folder in (package / kind, package.parent / IN_CHECKOUT[kind]):
        if folder.is_dir():
            return folder
    raise FileAccessError(f"{kind}: this installation has no {kind}; install geokit again")


def sample_path(name: str) -> Path:
    """Path of one of the sample files that come with geokit, as torus.ply or smoke.vdb.

    Args:
        name: File name of a sample.
    Returns:
        Path of the file.
    Raises:
        InputError: There is no such sample.
        FileAccessError: The installation lacks the samples.
    Example:
        >>> sample_path("torus.ply").name
        'torus.ply'
    """
    folder = folder_of("samples")
    names = sorted(path.name for path in folder.iterdir() if path.suffix in (".obj", ".ply", ".stl", ".vdb"))
    if name not in names:
        raise InputError(f"sample_path: there is no {name!r}; choose one of {', '.join(names)}")
    return folder / name
