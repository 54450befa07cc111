"""Mesh files that other libraries write: VTK's and meshio's formats with data, scenes, USD."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geokit.errors import MissingDependencyError
from geokit.mesh._model import TriangleMesh

__all__ = ["write_meshio", "write_poly_data", "write_trimesh", "write_usd"]

Data = Mapping[str, NDArray]


def write_poly_data(path: Path, mesh: TriangleMesh, point_data: Data, cell_data: Data) -> None:
    """VTK poly data, .vtp (compressed) or legacy .vtk (binary), through pyvista.

    Not meshio, whose legacy files name 32-bit integers in a way that VTK cannot read.
    """
    import pyvista

    padded = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces]).ravel()
    surface = pyvista.PolyData(np.array(mesh.vertices), padded)
    for name, values in point_data.items():
        surface.point_data[name] = values
    for name, values in cell_data.items():
        surface.cell_data[name] = values
    surface.save(path)


def write_meshio(path: Path, mesh: TriangleMesh, point_data: Data, cell_data: Data) -> None:
    """VTK .vtu, Gmsh .msh 4.1 (both binary), and .xdmf in one file, through meshio."""
    import meshio

    kind = path.suffix.lower()
    content = meshio.Mesh(
        np.array(mesh.vertices),
        [("triangle", np.array(mesh.faces))],
        point_data={name: np.array(values) for name, values in point_data.items()},
        cell_data={name: [np.array(values)] for name, values in cell_data.items()},
    )
    # Inline, since arrays in a second file could not be replaced together with the first.
    options = {"data_format": "XML"} if kind == ".xdmf" else {}
    file_format = {".vtu": "vtu", ".msh": "gmsh", ".xdmf": "xdmf"}[kind]
    # meshio prints advice to standard output and warns about its own choices.
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        meshio.write(path, content, file_format=file_format, **options)


def write_trimesh(path: Path, mesh: TriangleMesh) -> None:
    """.glb and .3mf through trimesh, one node for each part."""
    import trimesh

    name = mesh.name or "mesh"
    content = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    scene = trimesh.Scene()
    scene.add_geometry(content, node_name=name, geom_name=name)
    path.write_bytes(scene.export(file_type=path.suffix[1:].lower()))


def write_usd(path: Path, mesh: TriangleMesh) -> None:
    """One Mesh prim below a default root, through usd-core.

    Raises:
        MissingDependencyError: usd-core is not installed.
    """
    try:
        from pxr import Tf, Usd, UsdGeom, Vt
    except ImportError:
        raise MissingDependencyError(
            "reading and writing USD needs the package usd-core; install it with: pip install 'geokit[usd]'"
        ) from None
    stage = Usd.Stage.CreateInMemory()
    root = UsdGeom.Xform.Define(stage, "/root")
    stage.SetDefaultPrim(root.GetPrim())
    prim = UsdGeom.Mesh.Define(stage, f"/World/{Tf.MakeValidIdentifier(mesh.name or 'mesh')}")
    points = np.ascontiguousarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces).reshape(-1)))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    if len(points):
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    stage.GetRootLayer().Export(str(path))
