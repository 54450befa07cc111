"""Packages besides NumPy and warp: what needs each of them, and what installs it.

Each is imported where it is needed first, so that queries work without them. Standard library only.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

from geokit.core.base.interrupts import signals_held
from geokit.errors import MissingDependencyError

# What pip knows geokit by: the project "geokit" on PyPI is another one.
DISTRIBUTION = "geokit-nanovdb"


class Package(NamedTuple):
    """A row of the table.

    Args:
        name: What pip installs.
        needed_by: Subject of "needs the package ...".
        extra: The extra of geokit that installs it; "" if the base installation does.
    """

    name: str
    needed_by: str
    extra: str = ""


# By the name that is imported.
PACKAGES: dict[str, Package] = {
    "trimesh": Package("trimesh", "writing a .glb file"),
    "meshio": Package("meshio", "a .vtu, .msh or .xdmf file"),
    "vtkmodules": Package("vtk", "a .vtk, .vtp, .vtu or .vti file,", extra="figures"),
    "pyvista": Package("pyvista", "a figure, an object of PyVista, and writing .vtk or .vtp,", extra="figures"),
    "manifold3d": Package("manifold3d", "a union, difference or intersection of solids"),
    "matplotlib": Package("matplotlib", "a chart or a color scale", extra="figures"),
    "PIL": Package("pillow", "a texture, or a report with figures"),
    "blosc": Package("blosc", "a .nvdb file with codec blosc"),
    "cyclopts": Package("cyclopts", "the command line"),
    "rich": Package("rich", "the command line"),
    "pxr": Package("usd-core", "a .usd, .usda, .usdc or .usdz file", extra="usd"),
    "laspy": Package("laspy", "a .las or .laz file", extra="las"),
    "lazrs": Package("lazrs", "compressed points (.laz)", extra="las"),
    "pye57": Package("pye57", "an .e57 file", extra="e57"),
    "collada": Package("pycollada", "a .dae file", extra="dae"),
    "ufbx": Package("ufbx", "an .fbx file", extra="fbx"),
    "OCP": Package("cadquery-ocp-novtk", "a .step, .stp, .iges or .igs file", extra="cad"),
    "scipy": Package("scipy", "a fair patch of a hole", extra="fair"),
    "distributed": Package("distributed", "a Dask cluster", extra="dask"),
    "dask": Package("dask", "a query of a dask array", extra="dask"),
    "nibabel": Package("nibabel", "a .nii or .nii.gz file", extra="medical"),
    "nrrd": Package("pynrrd", "a .nrrd or .nhdr file", extra="medical"),
    "mrcfile": Package("mrcfile", "an .mrc or .map file", extra="imaging"),
    "pydicom": Package("pydicom", "a DICOM series", extra="medical"),
    "zarr": Package("zarr", "a .zarr folder", extra="imaging"),
    "tifffile": Package("tifffile", "a .tif or .tiff file", extra="imaging"),
    "h5py": Package("h5py", "an .xdmf file with arrays in HDF5", extra="xdmf"),
}


def remedy(module: str) -> str:
    """The command that installs a package of the table."""
    package = PACKAGES[module]
    return f"pip install '{DISTRIBUTION}[{package.extra}]'" if package.extra else f"pip install {package.name}"


def require_package(module: str) -> Any:
    """Import a package of the table, or one of its modules.

    Raises:
        MissingDependencyError: It is not installed; the message says what needs it and the command that installs it.
        ImportError: It is installed, and there is no memory for it.
    """
    try:
        # Some take an interrupt within for a package that is missing, or leave half a module, which crashes at the end.
        with signals_held():
            return importlib.import_module(module)
    except ImportError as error:
        # No memory for a shared library: operations say what they need.
        if any(text in str(error).lower() for text in ("failed to map segment", "cannot allocate memory")):
            raise
        top = module.partition(".")[0]
        # What a damaged package says of itself is worth more than advice that the user has followed already.
        reason = "" if isinstance(error, ModuleNotFoundError) and error.name in (top, module) else f" ({error})"
        raise MissingDependencyError(
            f"{PACKAGES[top].needed_by} needs the package {PACKAGES[top].name}{reason}; install it with: {remedy(top)}"
        ) from None
