"""Every file format that geokit knows, by extension. To add one, write a module beside this file and a line below.

What a module has, as far as its line says so:

- ``read_mesh(path) -> list[Body]`` and ``write_mesh(path, mesh)``, with ``point_data`` and ``cell_data`` as further
  arguments where the format holds data on vertices and faces;
- ``read_points(path) -> (points (N, 3) float64, data by name)`` and ``write_points(path, points, data)``, with
  ``encoding`` as a further argument where there are several;
- ``read_rays(path)``, a table (N, 6) of origins and directions;
- ``content_bytes(path)``, for point formats that are read in a process of their own: a check of the file's header that
  tells how many bytes the content may take, or None where it is safe to read the file in this process;
- ``lacks_faces(head)``, where a file of the format may be a mesh or a point cloud: whether the first bytes of a file
  announce no faces.

A damaged file is a FileFormatError that begins with the path. Paths have the extension in question, in lower case or
not. A module that is read in a process of its own imports little at its top: the process waits for it.

Standard library only: the command line reads this table before anything else.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Literal, NamedTuple

__all__ = ["FORMATS", "Access", "Content", "Format", "extensions", "module_of"]

Access = Literal["", "r", "w", "rw"]
Content = Literal["mesh", "points", "rays", "volume"]


class Format(NamedTuple):
    """A line of the table.

    Args:
        module: The module in this folder; "" for volumes, which ``geokit.volume`` reads and writes.
        mesh: Whether meshes are read and written.
        points: Whether point clouds are.
        rays: Whether rays are.
        volume: Whether volumes are.
        data: Mesh files hold arrays on vertices and faces.
        float32: Written meshes have float32 coordinates.
        process: Read in a process of its own, since its library hangs, crashes or prints on damaged files.
        extra: The extra of geokit that installs its library, "" where the base installation does.
        encodings: Of point clouds, the usual one first; empty where there is only one.
        single: Float32 points are written as such. Other formats get them as float64.
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
    # VTK; meshes are written by pyvista, .vtu by meshio.
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
    # geokit's own again.
    ".pcd": Format("pcd", points="rw", encodings=("binary", "ascii", "binary_compressed"), single=True),
    ".pts": Format("pts", points="rw"),
    # laspy; only compressed content, in a file of either name, is read in a process of its own.
    ".las": Format("las", points="rw", process=True, extra="las"),
    ".laz": Format("las", points="rw", process=True, extra="las"),
    # Tables.
    ".xyz": Format("text", points="rw", rays="r"),
    ".csv": Format("text", points="rw", rays="r"),
    ".txt": Format("text", points="r", rays="r"),
    ".npy": Format("numpy_files", points="r", rays="r"),
    ".npz": Format("numpy_files", points="rw", rays="r"),
    # OpenVDB, and geokit's own.
    ".vdb": Format("", volume="rw"),
    ".nvdb": Format("", volume="rw"),
}


def extensions(content: Content, access: Literal["r", "w"]) -> tuple[str, ...]:
    """Extensions of the formats whose ``content`` can be read ("r") or written ("w"), in the table's order."""
    return tuple(kind for kind, found in FORMATS.items() if access in getattr(found, content))


def module_of(kind: str) -> ModuleType:
    """The module that reads and writes files of an extension."""
    return importlib.import_module(f"geokit.formats.{FORMATS[kind].module}")
