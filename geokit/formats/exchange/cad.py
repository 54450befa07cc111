"""Parts of CAD programs (.step, .iges), tessellated by Open CASCADE (OCP), which reads in a separate process."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.memory.row_products import row_product
from geokit.errors import FileFormatError
from geokit.formats.file_content.body import Body

# Largest distance between a curved face and its triangles, over the diagonal of the file's box, and the largest angle
# between neighboring normals [rad].
DEFLECTION, ANGLE = 1e-4, 0.2
# That angle where a tolerance is given: Open CASCADE's own, so that the tolerance decides.
COARSE_ANGLE = 0.5
# Of these distances Open CASCADE is asked for so much: its triangles of spheres, ellipsoids and tori are up to 2.05
# times as far off as it is told.
ASKED = 0.4
# Over the diagonal: corners of neighboring faces that are one differ by rounding only, and edges of .iges, where each
# face has its own, by no more than this.
SAME, SEWN = 1e-9, 1e-5
_IGES = (".iges", ".igs")
_MODULES = (
    "Bnd", "BRep", "BRepBndLib", "BRepBuilderAPI", "BRepMesh", "IFSelect", "IGESControl", "STEPControl",
    "TopAbs", "TopExp", "TopLoc", "TopoDS",
)  # fmt: skip


def prepare() -> None:
    """Import the parts of Open CASCADE that are needed."""
    for name in _MODULES:
        require_package(f"OCP.{name}")


def read_mesh(path: Path, tolerance: float | None = None) -> list[Body]:
    """Read each solid as a body, and all faces that belong to none as one more, as triangles in millimeters.

    Triangles are within the tolerance of the true faces, by Open CASCADE's estimate with a reserve, and closed where
    the solid is.
    Faces of .iges, which have no neighbors there, are sewn together. Names and colors are left out; a warning tells how
    many faces of a .step are not read.

    Args:
        path: The file.
        tolerance: Largest distance between a face and its triangles [mm]; None for 1e-4 of the diagonal of the file's
            box.
    Raises:
        FileFormatError: The file is damaged, or holds no faces.
    """
    prepare()
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.TopAbs import TopAbs_FACE, TopAbs_SOLID

    shape = _shape(path)
    around = Bnd_Box()
    if shape is not None and not shape.IsNull():
        BRepBndLib.Add_s(shape, around)
    if around.IsVoid():
        raise FileFormatError(f"{path}: holds no faces; export the solids or surfaces themselves")
    size = around.CornerMin().Distance(around.CornerMax())
    if path.suffix.lower() in _IGES:
        shape = _sewn(shape, SEWN * size)
    if tolerance is None:
        BRepMesh_IncrementalMesh(shape, ASKED * DEFLECTION * size, False, ANGLE, False)
    else:
        BRepMesh_IncrementalMesh(shape, ASKED * tolerance, False, COARSE_ANGLE, False)
    solids = list(_parts(shape, TopAbs_SOLID))
    groups = [list(_parts(solid, TopAbs_FACE)) for solid in solids]
    groups.append(list(_parts(shape, TopAbs_FACE, TopAbs_SOLID)))
    bodies, empty = [], 0
    for faces in groups:
        triangles = [_triangles(face) for face in faces]
        empty += sum(not len(found) for found in triangles)
        if any(map(len, triangles)):
            bodies.append(_body(np.concatenate(triangles), SAME * size))
    if not bodies:
        raise FileFormatError(f"{path}: none of its faces can be tessellated; repair the part and export it again")
    if path.suffix.lower() not in _IGES:
        # A .step declares its faces, those of repeated parts once; Open CASCADE leaves out what it cannot make.
        declared = len(re.findall(rb"\b(?:ADVANCED_FACE|FACE_SURFACE)\b", path.read_bytes()))
        empty += max(declared - sum(map(len, groups)), 0)
    notes = (f"{empty} of its faces are not read",) if empty else ()
    bodies[0] = bodies[0]._replace(meters_per_unit=1e-3, notes=notes)
    return bodies


def _shape(path: Path) -> Any:
    """The content of the file as one shape; None if there is none."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.IGESControl import IGESControl_Reader
    from OCP.STEPControl import STEPControl_Reader

    reader = IGESControl_Reader() if path.suffix.lower() in _IGES else STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_RetDone:
        raise FileFormatError(f"{path}: Open CASCADE cannot read it; the file is damaged, export it again")
    reader.TransferRoots()
    return reader.OneShape()


def _sewn(shape: Any, tolerance: float) -> Any:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Sewing

    sewing = BRepBuilderAPI_Sewing(tolerance)
    sewing.Add(shape)
    sewing.Perform()
    return sewing.SewedShape()


def _parts(shape: Any, kind: Any, *outside: Any) -> Iterator[Any]:
    from OCP.TopExp import TopExp_Explorer

    explorer = TopExp_Explorer(shape, kind, *outside)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _triangles(shape: Any) -> NDArray[np.float64]:
    """The corners (T, 3, 3) of a face's triangles, counterclockwise from outside."""
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_REVERSED
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    location = TopLoc_Location()
    found = BRep_Tool.Triangulation_s(TopoDS.Face(shape), location)
    if found is None or not found.NbTriangles():
        return np.empty((0, 3, 3))
    place = location.Transformation()
    matrix = np.array([[place.Value(row, column) for column in range(1, 5)] for row in range(1, 4)])
    points = np.array([found.Node(row).Coord() for row in range(1, found.NbNodes() + 1)])
    corners = np.array([found.Triangle(row).Get() for row in range(1, found.NbTriangles() + 1)]) - 1
    if (shape.Orientation() == TopAbs_REVERSED) != (np.linalg.det(matrix[:, :3]) < 0.0):
        corners = corners[:, ::-1]
    return row_product(points, matrix[:, :3].T, matrix[:, 3])[corners]


def _body(soup: NDArray[np.float64], same: float) -> Body:
    """Triangles whose equal corners are merged: along each axis, coordinates closer than ``same`` are one."""
    points = soup.reshape(-1, 3)
    ranks = np.empty(points.shape, np.int64)
    for axis, values in enumerate(points.T):
        order = np.argsort(values, kind="stable")
        ranks[order, axis] = np.cumsum(np.diff(values[order], prepend=values[order[0]]) > same)
    _, first, inverse = np.unique(ranks, axis=0, return_index=True, return_inverse=True)
    corners = inverse.reshape(-1, 3)
    # At the tip of a cone, an edge has no length.
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    return Body(points[first], np.full(len(corners), 3), corners.ravel())
