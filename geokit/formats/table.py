"""Table of all file formats of geokit, by extension. To add one, write a module in this folder and a line below.

A module defines the functions that its line declares:

- ``read_mesh(path) -> list[Body]`` and ``write_mesh(path, mesh)``, with the further arguments ``point_data`` and
  ``cell_data`` if the format holds data on vertices and faces;
- ``read_points(path) -> (points (N, 3) float64, data by name)`` and ``write_points(path, points, data)``, with the
  further argument ``encoding`` if there are several encodings;
- ``read_rays(path)``, a table (N, 6) of origins and directions;
- ``content_bytes(path)``, for point formats that are read in a separate process: it checks the file's header and
  returns the largest size of the content in bytes, or None if the file can safely be read in this process;
- ``lacks_faces(head)``, if a file of the format may be a mesh or a point cloud: whether the first bytes of a file
  declare no faces.

A damaged file raises a FileFormatError whose message begins with the path. Paths have the extension in question, in
lower or upper case. A module that is read in a separate process imports little at its top, because the process waits
for it.

Standard library only, because the command line reads this table before anything else.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeVar

__all__ = ["FORMATS", "Access", "Content", "Format", "extensions", "module_of", "with_formats"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

Access = Literal["", "r", "w", "rw"]
Content = Literal["mesh", "points", "rays", "volume"]


class Format(NamedTuple):
    """A row of the table.

    Args:
        module: The module in this folder; "" for volumes, which ``geokit.volume`` reads and writes.
        mesh: Access to meshes: "r" for reading, "w" for writing, "rw" for both, "" for none.
        points: Access to point clouds.
        rays: Access to rays.
        volume: Access to volumes.
        data: Whether mesh files hold arrays on vertices and faces.
        float32: Whether meshes are written with float32 coordinates.
        process: Whether files are read in a separate process, because the library hangs, crashes or prints on damaged
            ones.
        extra: The extra of geokit that installs the library; "" if the base installation does.
        encodings: Encodings of point clouds, the default first; empty if there is only one.
        single: Whether float32 points are written as float32. Other formats write float64.
    """

    module: str
    mesh: Access = ""
    points: Access = ""
    rays: Access = ""
    volume: Access = ""
    data: bool = False
    float32: bool = False
    process: bool = False
    extra: str = ""
    encodings: tuple[str, ...] = ()
    single: bool = False


FORMATS: dict[str, Format] = {
    # geokit's own readers and writers.
    ".obj": Format("obj", mesh="rw", points="r"),
    ".ply": Format("ply", mesh="rw", points="rw"),
    ".stl": Format("stl", mesh="rw", float32=True),
    ".off": Format("off", mesh="rw"),
    # trimesh
    ".glb": Format("scenes", mesh="rw", float32=True, process=True),
    ".gltf": Format("scenes", mesh="r", process=True),
    ".3mf": Format("scenes", mesh="rw", process=True),
    # VTK. Meshes are written by pyvista, .vtu by meshio.
    ".vtk": Format("vtk", mesh="rw", data=True, process=True),
    ".vtp": Format("vtk", mesh="rw", points="rw", data=True, process=True),
    ".vtu": Format("vtk", mesh="rw", data=True, process=True),
    # meshio
    ".msh": Format("meshio_files", mesh="rw", data=True, process=True),
    ".xdmf": Format("meshio_files", mesh="rw", data=True, process=True),
    # usd-core
    ".usd": Format("usd", mesh="rw", float32=True, process=True, extra="usd"),
    ".usda": Format("usd", mesh="rw", float32=True, process=True, extra="usd"),
    ".usdc": Format("usd", mesh="rw", float32=True, process=True, extra="usd"),
    ".usdz": Format("usd", mesh="r", process=True, extra="usd"),
    # geokit's own readers and writers of points.
    ".pcd": Format("pcd", points="rw", encodings=("binary", "ascii", "binary_compressed"), single=True),
    ".pts": Format("pts", points="rw"),
    # laspy. Only compressed content, under either extension, is read in a separate process.
    ".las": Format("las", points="rw", process=True, extra="las"),
    ".laz": Format("las", points="rw", process=True, extra="las"),
    # Tables.
    ".xyz": Format("text", points="rw", rays="r"),
    ".csv": Format("text", points="rw", rays="r"),
    ".txt": Format("text", points="r", rays="r"),
    ".npy": Format("numpy_files", points="r", rays="r"),
    ".npz": Format("numpy_files", points="rw", rays="r"),
    # OpenVDB, and geokit's own reader and writer of .nvdb.
    ".vdb": Format("", volume="rw"),
    ".nvdb": Format("", volume="rw"),
}


def extensions(content: Content, access: Literal["r", "w"]) -> tuple[str, ...]:
    """List the extensions whose ``content`` can be read ("r") or written ("w"), in the table's order."""
    return tuple(kind for kind, found in FORMATS.items() if access in getattr(found, content))


def module_of(kind: str) -> ModuleType:
    """Import the module that reads and writes files with an extension."""
    return importlib.import_module(f"geokit.formats.{FORMATS[kind].module}")


def with_formats(content: Content, access: Literal["r", "w"]) -> Callable[[_Function], _Function]:
    """Decorator: replaces ``{formats}`` in a docstring by the extensions that can be read ("r") or written ("w")."""

    def fill(function: _Function) -> _Function:
        if function.__doc__:  # None under python -OO
            function.__doc__ = function.__doc__.replace("{formats}", " ".join(extensions(content, access)))
        return function

    return fill
