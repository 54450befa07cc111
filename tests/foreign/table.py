"""Files of other programs: one line a file. Where the tests' own environment has the writer they make the file; the
others are kept beside this table. `./dev foreign` makes all of them by the newest versions, and compares them.

What one writer can do to a format besides is in tests of the format (tests/formats/images/test_places.py,
test_dicom_zarr.py, tests/formats/test_ways_to_write_meshes.py, test_files_that_people_have.py, test_scans.py,
tests/native/test_bridge.py).
"""

from __future__ import annotations

import functools
import importlib.util
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from tests.foreign import writers
from tests.foreign.content import COLORS, FACE_IDS, HEIGHTS, INTENSITY, NORMALS, POINT_COLORS

__all__ = ["KEPT", "ONE_WRITER", "PACKAGES", "ROWS", "Row"]

KEPT = Path(__file__).with_name("kept")

# What pip installs for a writer, and the module by which it is known; programs have no module.
PACKAGES = {
    "assimp": ("", ""),
    "copclib": ("copclib", "copclib"),
    "gemmi": ("gemmi", "gemmi"),
    "gmsh": ("gmsh", "gmsh"),
    "lagrange": ("adobe-lagrange", "lagrange"),
    "laspy": ("laspy[lazrs,laszip]", "laspy"),
    "laszip": ("laszip", "laszip"),
    "lib3mf": ("lib3mf", "lib3mf"),
    "libigl": ("libigl", "igl"),
    "meshio": ("meshio h5py", "meshio"),
    "midvoxio": ("midvoxio", "midvoxio"),
    "mrcfile": ("mrcfile", "mrcfile"),
    "nanovdb_convert": ("", ""),
    "nibabel": ("nibabel", "nibabel"),
    "numpy": ("numpy", "numpy"),
    "numpy-stl": ("numpy-stl", "stl"),
    "ome-zarr": ("ome-zarr", "ome_zarr"),
    "open3d": ("open3d", "open3d"),
    "pandas": ("pandas", "pandas"),
    "pillow": ("pillow", "PIL"),
    "plyfile": ("plyfile", "plyfile"),
    "polars": ("polars", "polars"),
    "py-vox-io": ("py-vox-io", "pyvox"),
    "pycollada": ("pycollada", "collada"),
    "pydicom": ("pydicom", "pydicom"),
    "pye57": ("pye57", "pye57"),
    "pyevtk": ("pyevtk", "pyevtk"),
    "pygltflib": ("pygltflib", "pygltflib"),
    "pymeshlab": ("pymeshlab", "pymeshlab"),
    "pynrrd": ("pynrrd", "nrrd"),
    "pyopenvdb": ("", ""),
    "pypcd4": ("pypcd4", "pypcd4"),
    "pyvista": ("pyvista", "pyvista"),
    "simpleitk": ("SimpleITK", "SimpleITK"),
    "tensorstore": ("tensorstore", "tensorstore"),
    "tifffile": ("tifffile", "tifffile"),
    "tinyvdb": ("tinyvdb", "tinyvdb"),
    "trimesh": ("trimesh lxml networkx", "trimesh"),
    "usd-core": ("usd-core", "pxr"),
    "vdb_tool": ("", ""),
    "zarr": ("zarr", "zarr"),
}  # fmt: skip
# Writers that the environment of the tests may lack, although Debian's packages or an extra bring some of them.
OUTSIDE = {
    "assimp", "copclib", "gemmi", "gmsh", "lagrange", "laszip", "lib3mf", "libigl", "midvoxio", "numpy-stl",
    "ome-zarr", "open3d", "plyfile", "polars", "py-vox-io", "pyevtk", "pygltflib", "pymeshlab", "pypcd4", "simpleitk",
    "tensorstore", "tinyvdb",
}  # fmt: skip

# Formats for which only one other writer is known that pip or Debian brings.
ONE_WRITER = {
    ".vtp": "others write it by VTK",
    ".fbx": "Autodesk's library is in neither place, Blender too large; tests/support/exchange_files.py has more",
    ".iges": "others write it by Open CASCADE too",
    ".usd": "others write it by usd-core, or only read it",
    ".usda": "as .usd",
    ".usdc": "as .usd",
    ".usdz": "as .usd",
    ".pts": "others only read it",
    ".las": "PDAL and LAStools are in neither place for all systems; .laz has three writers",
    ".e57": "others use the same library, or only read it",
    ".bin": "has no header: numbers as NumPy writes them",
    ".npy": "NumPy's own",
    ".npz": "NumPy's own",
}


class Row(NamedTuple):
    """A file.

    Args:
        kind: Extension.
        writer: A name of PACKAGES.
        make: Writes the file to a path.
        name: What sets it apart from other files of the writer.
        data: Arrays that come back with a mesh or a cloud; those of faces as "face:name".
        content: "mesh", "points", "image" or "grid"; by the format if empty.
        options: What differs from the content in ways that the format or the writer asks for: ``unit`` [m],
            ``up`` axis, ``scale`` and ``origin`` of voxels, ``flip`` (axes of the other convention), and others, see
            compare.py.
        limit: Why the file cannot hold all of the content, or what geokit documents that it leaves out; a warning
            may say so.
        large: Whether the file is too large to be kept: only `./dev foreign` makes it.
    """

    kind: str
    writer: str
    make: Callable[[Path], None]
    name: str = ""
    data: Mapping[str, Any] = MappingProxyType({})
    content: str = ""
    options: Mapping[str, Any] = MappingProxyType({})
    limit: str = ""
    large: bool = False

    @property
    def id(self) -> str:
        """A name for the file's folder."""
        return "-".join(part.replace(" ", "_") for part in (self.writer, self.name) if part) + self.kind

    @property
    def what(self) -> str:
        """What is loaded."""
        from geokit.formats.table import FORMATS  # not in the environment of the other programs

        found = FORMATS[self.kind]
        if self.content or found.mesh:
            return self.content or "mesh"
        return "image" if found.image else "grid" if found.volume else "points"

    @property
    def is_here(self) -> bool:
        """Whether the writer is in this environment."""
        module = PACKAGES[self.writer][1]
        if module:
            return importlib.util.find_spec(module) is not None
        # The tools of OpenVDB convert what the system's Python writes.
        is_found = self.writer == "assimp" or any(Path("/usr/lib/python3/dist-packages").glob("pyopenvdb*"))
        return is_found and (self.writer == "pyopenvdb" or shutil.which(self.writer) is not None)


def _row(kind: str, writer: str, make: Callable[..., None], name: str = "", **rest: Any) -> Row:
    own = {key: rest.pop(key) for key in ("data", "content", "options", "limit", "large") if key in rest}
    return Row(kind, writer, functools.partial(make, **rest), name, **own)


_COLOR = {"color": COLORS}
_DATA = {"height": HEIGHTS, "face:id": FACE_IDS}
_OPEN3D = {"rgb": POINT_COLORS, "normals": NORMALS}
_LAS = {"intensity": INTENSITY * 256, "rgb": POINT_COLORS}
# What formats say of the place of voxels: their sizes, or nothing.
_AT_ZERO = {"origin": [0, 0, 0]}
_BARE = {"origin": [0, 0, 0], "scale": [1, 1, 1]}
_CLOUD = {"intensity": INTENSITY}

ROWS = [
    # meshes
    _row(".obj", "trimesh", writers.trimesh_mesh, colors=True, data=_COLOR),
    _row(".obj", "open3d", writers.open3d_mesh, colors=True, data=_COLOR),
    _row(".obj", "pymeshlab", writers.pymeshlab_mesh, data=_COLOR),
    _row(".obj", "libigl", writers.libigl_mesh),
    _row(".obj", "lagrange", writers.lagrange_mesh),
    _row(".obj", "meshio", writers.meshio_mesh, arrays=False),
    _row(".ply", "trimesh", writers.trimesh_mesh, colors=True, data=_COLOR),
    _row(".ply", "trimesh", writers.trimesh_mesh, "ascii", encoding="ascii"),
    _row(".ply", "plyfile", writers.plyfile_mesh, data={**_COLOR, "face:id": FACE_IDS}),
    # The numbers of faces beside a list are in the wrong order of bytes there.
    _row(".ply", "plyfile", writers.plyfile_mesh, "big-endian", byte_order=">", data=_COLOR),
    _row(".ply", "plyfile", writers.plyfile_mesh, "text", text=True, data={**_COLOR, "face:id": FACE_IDS}),
    _row(".ply", "open3d", writers.open3d_mesh, colors=True, data=_COLOR),
    _row(".ply", "pymeshlab", writers.pymeshlab_mesh, data=_COLOR),
    _row(".ply", "meshio", writers.meshio_mesh, data={"height": HEIGHTS}),
    _row(".ply", "lagrange", writers.lagrange_mesh),
    _row(".ply", "pyvista", writers.pyvista_surface),
    _row(".stl", "numpy-stl", writers.numpy_stl_mesh),
    _row(".stl", "numpy-stl", writers.numpy_stl_mesh, "ascii", ascii=True),
    _row(".stl", "open3d", writers.open3d_mesh, normals=True),
    _row(".stl", "pymeshlab", writers.pymeshlab_mesh),
    _row(".stl", "trimesh", writers.trimesh_mesh),
    _row(".stl", "trimesh", writers.trimesh_mesh, "ascii", file_type="stl_ascii"),
    _row(".stl", "pyvista", writers.pyvista_surface, binary=False),
    _row(".off", "trimesh", writers.trimesh_mesh),
    _row(".off", "meshio", writers.meshio_mesh, arrays=False),
    _row(".off", "open3d", writers.open3d_mesh, colors=True),
    _row(".off", "pymeshlab", writers.pymeshlab_mesh),
    _row(".off", "libigl", writers.libigl_mesh),
    _row(".glb", "trimesh", writers.trimesh_mesh, colors=True, data=_COLOR),
    _row(".glb", "pygltflib", writers.pygltflib_mesh, data=_COLOR),
    _row(".glb", "open3d", writers.open3d_mesh, colors=True),
    _row(".glb", "lagrange", writers.lagrange_mesh),
    _row(".glb", "assimp", writers.assimp_mesh, code="glb2"),
    _row(".gltf", "pygltflib", writers.pygltflib_mesh, data=_COLOR),
    _row(".gltf", "trimesh", writers.trimesh_mesh),
    _row(".gltf", "lagrange", writers.lagrange_mesh),
    _row(".gltf", "assimp", writers.assimp_mesh, code="gltf2"),
    _row(".3mf", "lib3mf", writers.lib3mf_mesh, options={"unit": 0.0254, "up": "z"}),
    _row(".3mf", "trimesh", writers.trimesh_mesh, options={"unit": 0.001, "up": "z"}),
    _row(
        ".3mf",
        "assimp",
        writers.assimp_mesh,
        code="3mf",
        options={"unit": 0.001, "up": "z"},
        limit="materials of .3mf are left out",
    ),
    _row(".vtk", "pyvista", writers.pyvista_mesh, data=_DATA),
    _row(".vtk", "pyvista", writers.pyvista_mesh, "grid ascii", unstructured=True, binary=False, data=_DATA),
    _row(".vtk", "meshio", writers.meshio_mesh, data=_DATA),
    _row(".vtp", "pyvista", writers.pyvista_mesh, data=_DATA),
    _row(".vtp", "pyvista", writers.pyvista_mesh, "ascii", binary=False, data=_DATA),
    _row(".vtu", "pyvista", writers.pyvista_mesh, unstructured=True, data=_DATA),
    _row(".vtu", "pyevtk", writers.pyevtk_mesh, data=_DATA),
    _row(".vtu", "meshio", writers.meshio_mesh, data=_DATA),
    _row(".msh", "gmsh", writers.gmsh_mesh),
    _row(".msh", "gmsh", writers.gmsh_mesh, "binary", binary=True),
    _row(".msh", "gmsh", writers.gmsh_mesh, "2.2", version=2.2),
    _row(".msh", "gmsh", writers.gmsh_mesh, "2.2 binary", version=2.2, binary=True),
    _row(".msh", "gmsh", writers.gmsh_mesh, "4.0", version=4.0),
    _row(".msh", "lagrange", writers.lagrange_mesh),
    _row(".msh", "meshio", writers.meshio_mesh, file_format="gmsh", data=_DATA),
    _row(".msh", "meshio", writers.meshio_mesh, "2.2", file_format="gmsh22", data=_DATA),
    _row(".msh", "meshio", writers.meshio_mesh, "Fluent", file_format="ansys", arrays=False),
    _row(".xdmf", "meshio", writers.meshio_mesh, data=_DATA),
    _row(".xdmf", "meshio", writers.meshio_mesh, "text", data_format="XML", compression=None, data=_DATA),
    _row(".xdmf", "pyvista", writers.vtk_xdmf_mesh, data=_DATA),
    _row(".dae", "pycollada", writers.pycollada_mesh),
    _row(".dae", "assimp", writers.assimp_mesh, code="collada"),
    _row(".dae", "pymeshlab", writers.pymeshlab_mesh),
    # Its binary .fbx is none: assimp itself refuses it.
    _row(".fbx", "assimp", writers.assimp_mesh, "text", code="fbxa"),
    _row(".step", "gmsh", writers.gmsh_box, options={"box": True}),
    _row(
        ".stp",
        "assimp",
        writers.assimp_mesh,
        code="stp",
        options={"inside_out": True},
        limit="the planes of its faces face inward",
    ),
    _row(".iges", "gmsh", writers.gmsh_box, options={"box": True}),
    _row(".usda", "usd-core", writers.usd_mesh, options={"unit": 0.5, "up": "z"}),
    _row(".usdc", "usd-core", writers.usd_mesh, options={"unit": 0.5, "up": "z"}),
    _row(".usd", "usd-core", writers.usd_mesh, options={"unit": 0.5, "up": "z"}),
    _row(".usdz", "usd-core", writers.usd_mesh, options={"unit": 0.5, "up": "z"}),
    # clouds
    _row(
        ".ply",
        "open3d",
        writers.open3d_cloud,
        "cloud",
        content="points",
        data=_OPEN3D,
    ),
    _row(".ply", "pymeshlab", writers.pymeshlab_cloud, "cloud", content="points", data={"normals": NORMALS}),
    _row(".ply", "plyfile", writers.plyfile_cloud, "cloud", byte_order=">", content="points", data=_CLOUD),
    _row(".pcd", "open3d", writers.open3d_cloud, data=_OPEN3D),
    _row(".pcd", "open3d", writers.open3d_cloud, "compressed", compressed=True, data=_OPEN3D),
    _row(".pcd", "open3d", writers.open3d_cloud, "ascii", write_ascii=True, data=_OPEN3D),
    _row(".pcd", "pypcd4", writers.pypcd4_cloud, data=_CLOUD),
    _row(".pcd", "pypcd4", writers.pypcd4_cloud, "compressed", encoding="binary_compressed", data=_CLOUD),
    _row(".pcd", "pypcd4", writers.pypcd4_cloud, "ascii", encoding="ascii", data=_CLOUD),
    _row(".pts", "open3d", writers.open3d_cloud, data={"rgb": POINT_COLORS}),
    _row(".las", "laspy", writers.laspy_cloud, data=_LAS),
    _row(".las", "laspy", writers.laspy_cloud, "1.2", version="1.2", point_format=2, data=_LAS),
    _row(".laz", "laspy", writers.laspy_cloud, backend="LazrsParallel", data=_LAS),
    _row(".laz", "laszip", writers.laspy_cloud, backend="Laszip", data=_LAS),
    _row(".laz", "copclib", writers.copclib_cloud),
    _row(".e57", "pye57", writers.pye57_cloud, data=_CLOUD),
    _row(".bin", "numpy", writers.numpy_cloud, data={"reflectance": INTENSITY}),
    _row(".xyz", "numpy", writers.numpy_cloud),
    _row(".xyz", "open3d", writers.open3d_cloud),
    _row(".xyz", "pymeshlab", writers.pymeshlab_cloud),
    _row(".csv", "pandas", writers.pandas_cloud, data=_CLOUD),
    _row(".csv", "polars", writers.polars_cloud, data=_CLOUD),
    _row(".txt", "pandas", writers.pandas_cloud, data=_CLOUD),
    _row(".txt", "polars", writers.polars_cloud, data=_CLOUD),
    _row(".npy", "numpy", writers.numpy_cloud, "cloud", content="points"),
    _row(".npz", "numpy", writers.numpy_cloud, data=_CLOUD),
    _row(".vtp", "pyvista", writers.pyvista_cloud, "cloud", content="points", data=_CLOUD),
    # dense volumes
    _row(".nii", "nibabel", writers.nibabel_image),
    _row(".nii", "simpleitk", writers.simpleitk_image, options={"flip": [-1, -1, 1]}),
    _row(".nii.gz", "nibabel", writers.nibabel_image),
    _row(".nii.gz", "simpleitk", writers.simpleitk_image, options={"flip": [-1, -1, 1]}),
    _row(".nrrd", "pynrrd", writers.pynrrd_image),
    _row(".nrrd", "simpleitk", writers.simpleitk_image),
    _row(".nrrd", "simpleitk", writers.simpleitk_image, "compressed", compressed=True),
    _row(".nhdr", "pynrrd", writers.pynrrd_image),
    _row(".nhdr", "simpleitk", writers.simpleitk_image),
    _row(".mhd", "simpleitk", writers.simpleitk_image),
    _row(".mhd", "simpleitk", writers.simpleitk_image, "compressed", compressed=True),
    _row(".mhd", "pyvista", writers.vtk_meta_image, compressed=False),
    _row(".mha", "simpleitk", writers.simpleitk_image),
    _row(".mha", "simpleitk", writers.simpleitk_image, "compressed", compressed=True),
    _row(".mha", "pyvista", writers.vtk_meta_image, compressed=True),
    _row(".mrc", "mrcfile", writers.mrcfile_image),
    _row(".mrc", "gemmi", writers.gemmi_image, options=_AT_ZERO),
    _row(".map", "gemmi", writers.gemmi_image, options=_AT_ZERO),
    _row(".map", "mrcfile", writers.mrcfile_image),
    _row(".tif", "tifffile", writers.tifffile_image, options=_AT_ZERO),
    _row(".tif", "tifffile", writers.tifffile_ome, "ome", options=_AT_ZERO),
    _row(".tif", "tifffile", writers.tifffile_ome, "ome zlib", compression="zlib", predictor=True, options=_AT_ZERO),
    _row(".tif", "simpleitk", writers.simpleitk_image, options=_BARE),
    _row(".tif", "pillow", writers.pillow_image, options=_BARE),
    _row(
        ".tiff",
        "pillow",
        writers.pillow_image,
        "lzw",
        compression="tiff_lzw",
        options={"refused": "imagecodecs"},
        limit="tifffile decodes LZW with the package imagecodecs, which the error names",
    ),
    _row(".tiff", "simpleitk", writers.simpleitk_image, "compressed", compressed=True, options=_BARE),
    _row(".dcm", "pydicom", writers.pydicom_slices),
    _row(".dcm", "pydicom", writers.pydicom_slices, "rle", compressed=True),
    _row(".dcm", "simpleitk", writers.simpleitk_slices),
    _row(".zarr", "zarr", writers.zarr_image, options=_BARE),
    _row(".zarr", "zarr", writers.zarr_image, "2", version=2, options=_BARE),
    _row(".zarr", "ome-zarr", writers.ome_zarr_image, options=_AT_ZERO),
    _row(".zarr", "tensorstore", writers.tensorstore_image, options=_BARE),
    _row(".zarr", "tensorstore", writers.tensorstore_image, "2", driver="zarr", options=_BARE),
    _row(".vti", "pyvista", writers.pyvista_image),
    _row(".vti", "pyevtk", writers.pyevtk_image),
    _row(".npy", "numpy", writers.numpy_image, "image", content="image", options=_BARE),
    _row(".vox", "midvoxio", writers.midvoxio_voxels, options={"boxes": True}),
    _row(".vox", "py-vox-io", writers.pyvox_voxels, options={"boxes": True}),
    # sparse volumes
    _row(".vdb", "lagrange", writers.lagrange_grid),
    _row(".vdb", "lagrange", writers.lagrange_grid, "double zip", dtype="float64", codec="Zip"),
    _row(".vdb", "lagrange", writers.lagrange_grid, "none", codec="Uncompressed", large=True),
    _row(".vdb", "tinyvdb", writers.tinyvdb_grid),
    _row(".vdb", "pyopenvdb", writers.pyopenvdb_grid),
    _row(".vdb", "pyopenvdb", writers.pyopenvdb_grid, "half", half=True, options={"half": True}),
    _row(".vdb", "vdb_tool", writers.vdb_tool_grid),
    _row(".nvdb", "lagrange", writers.lagrange_grid),
    _row(".nvdb", "lagrange", writers.lagrange_grid, "double zip", dtype="float64", codec="Zip"),
    _row(".nvdb", "lagrange", writers.lagrange_grid, "none", codec="Uncompressed", large=True),
    _row(".nvdb", "nanovdb_convert", writers.nanovdb_convert_grid),
    _row(".nvdb", "nanovdb_convert", writers.nanovdb_convert_grid, "zip", codec="zip"),
    _row(".nvdb", "nanovdb_convert", writers.nanovdb_convert_grid, "blosc", codec="blosc"),
]
