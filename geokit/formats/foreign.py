"""Files of other programs that geokit does not read, and what makes a file of them that it does."""

from __future__ import annotations

import os
from typing import Literal, NamedTuple

from geokit.core.files import extension, is_there, require_extension
from geokit.core.require import require_path
from geokit.errors import FileAccessError, InputError
from geokit.formats.table import FORMATS, Content, extensions


class Foreign(NamedTuple):
    """A row of the table.

    Args:
        name: What the files are called.
        remedy: What to do, as the end of an error: which program writes which format of geokit.
    """

    name: str
    remedy: str


def _rows(kinds: str, name: str, remedy: str) -> dict[str, Foreign]:
    return dict.fromkeys(kinds.split(), Foreign(name, remedy))


# The modules of the API, and what they read and write.
_DOORS: dict[str, Content] = {"mesh": "mesh", "volume": "volume", "points": "points"}
_ASSIMP = "convert it with: assimp export FILE FILE.glb"

# By extension.
FOREIGN: dict[str, Foreign] = {
    # Scenes.
    **_rows(".3ds .ase .x .lwo .ac .ms3d", "a scene of an older program", _ASSIMP),
    **_rows(".x3d .x3dv .x3db", "X3D", "open it in Blender or view3dscene and export .glb"),
    **_rows(".wrl .vrml", "VRML", "open it in MeshLab or view3dscene and export .ply or .glb"),
    **_rows(".amf", "Additive Manufacturing Format", "open it in PrusaSlicer or Cura and export .3mf"),
    **_rows(".blend", "a scene of Blender", "export it from Blender as .glb (File > Export)"),
    **_rows(".max", "a scene of 3ds Max", "export it from 3ds Max as .fbx or .usd"),
    **_rows(".ma .mb", "a scene of Maya", "export it from Maya as .fbx or .usd"),
    **_rows(".c4d", "a scene of Cinema 4D", "export it from Cinema 4D as .fbx or .glb"),
    **_rows(".skp", "a model of SketchUp", "export it from SketchUp as .dae"),
    **_rows(".abc", "Alembic", "open it in Blender or Houdini and export .usd"),
    **_rows(".bgeo .geo .hip", "a file of Houdini", "write .usd or .obj in Houdini"),
    **_rows(".drc", "Draco", "decompress it with: draco_decoder -i FILE.drc -o FILE.ply"),
    **_rows(".vrm", "an avatar in glTF", "rename it .glb"),
    **_rows(".b3dm", "a 3D tile", "convert it with: 3d-tiles-tools b3dmToGlb -i FILE.b3dm -o FILE.glb"),
    **_rows(".ctm", "OpenCTM", "open it in MeshLab and export .ply"),
    **_rows(".mesh .meshb .node .ele", "a mesh of INRIA or TetGen", "convert it with: meshio convert FILE FILE.vtu"),
    **_rows(".splat .spz .ksplat", "Gaussian splats", "export them as .ply, which is read as points"),
    # CAD.
    **_rows(".dxf .dwg", "a drawing of AutoCAD", "export its solids as .stl, or its meshes as .obj"),
    **_rows(".3dm", "a model of Rhino", "export it from Rhino as .obj or .3mf"),
    **_rows(".brep", "a part of Open CASCADE", "export it from FreeCAD as .step"),
    **_rows(".fcstd", "a document of FreeCAD", "export it from FreeCAD as .step or .obj"),
    **_rows(".sldprt .sldasm .ipt .iam .catpart .catproduct .prt .asm .par .x_t .x_b .sat .sab .jt",
            "a part of a CAD program", "export it there as .step, or as .stl or .3mf"),
    **_rows(".ifc", "a building model", "convert it with: IfcConvert FILE.ifc FILE.glb"),
    # Simulations.
    **_rows(".inp .bdf .nas .fem .cdb .unv .med .su2 .cgns .e .exo .ex2",
            "a finite element model", "convert its surface with: meshio convert FILE FILE.vtu"),
    **_rows(".vtm .pvd .pvtp .pvtu .case .foam", "a set of files",
            "open it in ParaView, merge its blocks, extract the surface and save .vtp"),
    # Points.
    **_rows(".ptx .fls .zfs .rcp .rcs .rdbx", "a scan of a scanner's own program",
            "export it as .e57 there, or in CloudCompare"),
    **_rows(".bag .db3 .mcap", "a recording of ROS", "extract its clouds as .pcd with: ros2 run pcl_ros bag_to_pcd"),
    **_rows(".asc .pnt .neu", "text of points", "rename it .xyz if each line is x y z and further numbers"),
    **_rows(".h5 .hdf5 .mat", "arrays in a container", "load the array with h5py or SciPy and pass it, or save .npz"),
    **_rows(".pcap .pcapng", "packets of a lidar", "export it from VeloView or the sensor's program as .csv or .pcd"),
    # Volumes.
    **_rows(".raw .vol", "voxels of a size that no header says",
            "write a header .mhd beside it, or pass the array to volume.from_dense"),
    **_rows(".img .hdr", "a volume in two files", "convert it with: nib-convert FILE.hdr FILE.nii"),
    **_rows(".mgz .mgh", "a volume of FreeSurfer", "convert it with: mri_convert FILE FILE.nii.gz"),
    **_rows(".czi .lif .nd2 .oib .ims", "an image of a microscope", "export it from Fiji as .tif (OME)"),
    **_rows(".binvox", "voxels of binvox", "load it with trimesh and pass its matrix to volume.from_dense"),
    **_rows(".vtr .vts .pvti", "a grid of VTK", "resample it to an image in ParaView and save .vti"),
    **_rows(".parquet .feather .arrow", "a table", "write it with pandas as .csv"),
    **_rows(".pt .pth .pkl .pickle", "pickled objects",
            "load it where it was written and pass its arrays, or save .npz"),
    **_rows(".zip .gz .bz2 .xz .7z .rar .tar .tgz .zst", "a packed file", "unpack it first"),
}  # fmt: skip


def refuse_foreign(path: str | os.PathLike[str]) -> None:
    """Refuse a file to read that is known and not read.

    Raises:
        InputError: It is one of the table; the message has the remedy.
    """
    kind = extension(path)
    if kind in FOREIGN:
        name, remedy = FOREIGN[kind]
        raise InputError(f"{require_path(path)}: '{kind}' is {name}, which geokit does not read; {remedy}")


def require_format(
    path: str | os.PathLike[str], content: Content, access: Literal["r", "w"], what: str | None = None
) -> str:
    """Return the extension of a file, whose ``content`` can be read ("r") or written ("w").

    Args:
        path: The file.
        content: What it holds.
        access: What is done with it.
        what: What the content is called in errors; None is ``content``.
    Raises:
        InputError: It cannot; the message has the remedy for it, names the functions that can, or lists the extensions.
        FileAccessError: It is a folder.
    """
    known, path = extensions(content, access), require_path(path)
    kind = extension(path)
    if kind in known:
        return kind
    if access == "r":
        refuse_foreign(path)
    verb, does = ("load", "reads") if access == "r" else ("save", "writes")
    doors = [door for door in _DOORS if _DOORS[door] != content and kind in extensions(_DOORS[door], access)]
    if doors:
        others = " or ".join(f"geokit.{door}.{verb}" for door in doors)
        raise InputError(f"{path}: '{kind}' is not a {what or content} format; use {others}, which {does} it")
    if is_there(path) and path.is_dir():
        folders = ", or read slices of DICOM with geokit.volume.load" if access == "r" else ""
        raise FileAccessError(f"{path}: is a directory; name a file in it{folders}")
    if kind in FORMATS:
        raise InputError(f"{path}: '{kind}' is only read; use one of {', '.join(sorted(known))}")
    return require_extension(path, known, what or content)
