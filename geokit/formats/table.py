"""Table of all file formats of geokit, by extension. To add one, write a module in this folder and a line below.

A module defines the functions that its line declares:

- ``read_mesh(path) -> list[Body]`` and ``write_mesh(path, mesh)``, whose mesh has only such attributes as the line says
  the format holds, and only arrays and images for which ``holds_type(values, kind)``, ``holds_name(name, kind)`` and
  ``holds_texture(data)`` are true where the module defines these, and alpha cutoffs unless it says
  ``HOLDS_CUTOFFS = False``; ``read_mesh`` also takes ``folders`` if files of the format may refer to other files: these
  are opened only in the file's own folder and in ``folders`` (references.py);
- ``companions(mesh, path) -> {name: bytes}``, if a mesh may become several files: those that lie beside ``path``.
  Where there are any, ``write_mesh`` also takes the ``stem`` of their names. ``companions_of(path) -> {name}``: the
  names of those of a file that is there;
- ``read_points(path) -> (points (N, 3) float64, data by name)`` and ``write_points(path, points, data)``, with the
  further argument ``encoding`` if there are several encodings;
- ``read_rays(path)``, a table (N, 6) of origins and directions;
- ``content_bytes(path)``, if files of the format are or may be compressed: the size of the decompressed content in
  bytes, from the file's header, before anything is decompressed; 0 if the file does not tell; None if this file is not
  compressed, and then it is read in this process also where the line says otherwise;
- ``IN_PROCESS = False``, if the library must never read in the caller's process, whatever the caller trusts;
- ``lacks_faces(head)``, if a file of the format may be a mesh or a point cloud: whether the first bytes of a file
  declare no faces.

Dense volumes have modules in ``images/``: ``open_images(path, limit)`` and ``write_image(path, image, codec)``, with
the further argument ``stem`` if the format ``references`` a second file. Where the extension is one of clouds too,
``is_volume(path)`` tells.

A damaged file raises a FileFormatError whose message begins with the path. Paths have the extension in question, in
lower or upper case. A module that is read in a separate process imports little at its top, because the process waits
for it.

Standard library only, because the command line reads this table before anything else.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])

Access = Literal["", "r", "w", "rw"]
Content = Literal["mesh", "points", "rays", "volume"]


class Format(NamedTuple):
    """A row of the table.

    Args:
        module: The module in this folder; "" for what ``geokit.native`` and ``geokit.volume`` read and write.
        mesh: Access to meshes: "r" for reading, "w" for writing, "rw" for both, "" for none.
        points: Access to point clouds.
        rays: Access to rays.
        volume: Access to volumes.
        image: The module in ``images/`` of a dense volume; "" if there is none.
        vertex: Attributes of vertices that mesh files hold: the names of those with a meaning ("rgb" is a color without
            alpha), or "*" for all arrays.
        face: The same for faces. Attributes of corners that it does not hold are written for vertices, where these may
            have them.
        corner: The same for corners.
        materials: Whether they hold materials, and which face has which.
        unit: Whether they hold the length of their unit. Formats that do not are taken to be in meters.
        default_unit: The unit that files state, by the format's specification, where none is known; "" if they may
            leave it out.
        fixed_up: The axis that points up in all files by the format's specification; "" if there is none.
        float32: Whether meshes are written with float32 coordinates.
        process: Whether files are read in a separate process, because the library hangs, crashes or prints on damaged
            ones.
        extra: The extra of geokit that installs the library; "" if the base installation does.
        encodings: Encodings of point clouds, the default first; empty if there is only one.
        single: Whether float32 points are written as float32. Other formats write float64.
        references: Whether files may refer to other files.
        limited: Whether point clouds hold only some arrays: such files hold no answers of queries.
        arrays: Names of the only arrays that point clouds hold; empty if they hold any.
        curved: Whether meshes have curved faces in the file, for which ``read_mesh`` takes a ``tolerance``.
        series: Whether meshes may have time steps, of which ``read_mesh`` takes the number of one as ``step``.
        up: The axis that points up in most files, "y" or "z"; pictures are drawn so unless told otherwise.
    """

    module: str
    mesh: Access = ""
    points: Access = ""
    rays: Access = ""
    volume: Access = ""
    image: str = ""
    vertex: str = ""
    face: str = ""
    corner: str = ""
    materials: bool = False
    unit: bool = False
    default_unit: str = ""
    fixed_up: str = ""
    float32: bool = False
    process: bool = False
    extra: str = ""
    encodings: tuple[str, ...] = ()
    single: bool = False
    references: bool = False
    limited: bool = False
    arrays: tuple[str, ...] = ()
    curved: bool = False
    series: bool = False
    up: Literal["y", "z"] = "y"

    @property
    def data(self) -> bool:
        """Whether mesh files hold arrays of any name on vertices and faces."""
        return self.vertex == self.face == "*"


# What stands at the top of a zarr folder.
ZARR = ("zarr.json", ".zgroup", ".zarray")
# Arrays of any name on vertices and faces.
_ARRAYS: Any = {"vertex": "*", "face": "*"}
# Parts, simulations and surveys stand on the xy plane, characters and scenes on the xz plane.
_Z: Any = {"up": "z"}
_GLTF = Format(
    "scenes", mesh="rw", vertex="*", materials=True, default_unit="meter", fixed_up="y", float32=True, process=True,
    references=True,
)  # fmt: skip
_USD = Format(
    "usd", mesh="rw", volume="rw", **_ARRAYS, corner="*", materials=True, unit=True, float32=True, process=True,
    references=True, extra="usd",
)  # fmt: skip

FORMATS: dict[str, Format] = {
    # geokit's own readers and writers.
    ".obj": Format(
        "obj", mesh="rw", points="r", vertex="normal uv rgb", corner="normal uv", materials=True, references=True
    ),
    ".ply": Format("ply", mesh="rw", points="rw", vertex="*", face="*", corner="*", references=True),
    ".stl": Format("stl", mesh="rw", float32=True, **_Z),
    ".off": Format("off", mesh="rw", vertex="normal uv color", face="color"),
    # geokit's own readers, whose content a small file can multiply; trimesh writes .glb without attributes.
    **dict.fromkeys((".glb", ".gltf"), _GLTF),
    ".3mf": Format(
        "exchange.three_mf", mesh="rw", unit=True, default_unit="millimeter", fixed_up="z", process=True, **_Z
    ),
    # VTK. Meshes are written by pyvista, .vtu by meshio.
    ".vtk": Format("vtk", mesh="rw", **_ARRAYS, unit=True, process=True, extra="figures", **_Z),
    ".vtp": Format("vtk", mesh="rw", points="rw", **_ARRAYS, unit=True, process=True, extra="figures", **_Z),
    ".vtu": Format("vtk", mesh="rw", **_ARRAYS, process=True, extra="figures", **_Z),
    # meshio
    ".msh": Format("meshio_files", mesh="rw", **_ARRAYS, process=True, references=True, **_Z),
    ".xdmf": Format("meshio_files", mesh="rw", **_ARRAYS, process=True, references=True, series=True, **_Z),
    # pycollada
    ".dae": Format("exchange.collada", mesh="r", process=True, references=True, extra="dae"),
    # ufbx
    ".fbx": Format("exchange.fbx", mesh="r", process=True, references=True, extra="fbx"),
    # Open CASCADE
    **dict.fromkeys(
        (".step", ".stp", ".iges", ".igs"),
        Format("exchange.cad", mesh="r", process=True, extra="cad", curved=True, **_Z),
    ),
    # usd-core
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD),
    # geokit's own readers and writers of points.
    ".pcd": Format("pcd", points="rw", encodings=("binary", "ascii", "binary_compressed"), single=True, **_Z),
    ".pts": Format("pts", points="rw", limited=True, arrays=("intensity", "rgb"), **_Z),
    # laspy. Only compressed content, under either extension, is read in a separate process.
    **dict.fromkeys((".las", ".laz"), Format("las", points="rw", process=True, extra="las", **_Z)),
    # pye57
    ".e57": Format("e57", points="r", process=True, extra="e57", **_Z),
    # Sweeps of KITTI and nuScenes, without a header.
    ".bin": Format("kitti", points="r", **_Z),
    # Tables.
    **dict.fromkeys((".xyz", ".csv"), Format("text", points="rw", rays="r", **_Z)),
    ".txt": Format("text", points="r", rays="r", **_Z),
    ".npy": Format("numpy_files", points="r", rays="r", volume="rw", image="numpy_image", **_Z),
    ".npz": Format("numpy_files", points="rw", rays="r", **_Z),
    # OpenVDB, and geokit's own reader and writer of .nvdb.
    ".vdb": Format("", points="rw", volume="rw", limited=True),
    ".nvdb": Format("", volume="rw"),
    # Dense volumes: nibabel, pynrrd, geokit's own readers, mrcfile, tifffile, pydicom, zarr, VTK.
    **dict.fromkeys((".nii", ".nii.gz"), Format("", volume="rw", image="nifti", extra="medical", **_Z)),
    ".nrrd": Format("", volume="rw", image="nrrd", extra="medical", **_Z),
    ".nhdr": Format("", volume="r", image="nrrd", extra="medical", **_Z),
    ".mhd": Format("", volume="rw", image="meta_image", references=True, **_Z),
    ".mha": Format("", volume="rw", image="meta_image", **_Z),
    ".mrc": Format("", volume="rw", image="mrc", default_unit="angstrom", extra="imaging", **_Z),
    ".map": Format("", volume="rw", image="mrc", default_unit="angstrom", extra="imaging", **_Z),
    **dict.fromkeys((".tif", ".tiff"), Format("", volume="rw", image="tiff", extra="imaging", **_Z)),
    ".dcm": Format("", volume="r", image="dicom", extra="medical", **_Z),
    ".zarr": Format("", volume="rw", image="zarr_image", extra="imaging", **_Z),
    ".vox": Format("", volume="r", image="vox", **_Z),
    ".vti": Format("", volume="rw", image="vti", extra="figures", **_Z),
}

# Scenes, which may hold meshes, or volumes of .vdb files.
STAGES = tuple(kind for kind, found in FORMATS.items() if found.volume and found.mesh)
# What stores only some voxels, and several grids in a file.
SPARSE = tuple(kind for kind, found in FORMATS.items() if found.volume and not found.image and not found.mesh)


def extensions(content: Content, access: Literal["r", "w"]) -> tuple[str, ...]:
    """List the extensions whose ``content`` can be read ("r") or written ("w"), in the table's order."""
    return tuple(kind for kind, found in FORMATS.items() if access in getattr(found, content))


def module_of(kind: str) -> ModuleType:
    """Import the module that reads and writes files with an extension."""
    return importlib.import_module(f"geokit.formats.{FORMATS[kind].module}")


def volume_kind(path: str | os.PathLike[str]) -> str:
    """The extension that a folder stands for: ".zarr", or ".dcm" for one with slices of DICOM; "" for a file."""
    folder = Path(path)
    if not os.path.isdir(folder):  # names too long for a file are no folder
        return ""
    return ".zarr" if any((folder / name).is_file() for name in ZARR) or folder.suffix.lower() == ".zarr" else ".dcm"


def image_module(kind: str) -> ModuleType:
    """Import the module that reads and writes dense volumes with an extension."""
    return importlib.import_module(f"geokit.formats.images.{FORMATS[kind].image}")


def with_formats(
    content: Content, access: Literal["r", "w"], **more: Iterable[str]
) -> Callable[[_Function], _Function]:
    """Decorator: replaces ``{formats}`` in a docstring by the extensions that can be read ("r") or written ("w").

    Further words in braces are replaced by the extensions given under their names.
    """

    def fill(function: _Function) -> _Function:
        for name, kinds in {"formats": extensions(content, access), **more}.items():
            if function.__doc__:  # None under python -OO
                function.__doc__ = function.__doc__.replace(f"{{{name}}}", " ".join(kinds))
        return function

    return fill
