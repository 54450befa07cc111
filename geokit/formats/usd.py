"""Meshes of USD stages, through usd-core, which reads in a separate process."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geokit.errors import FileFormatError, MissingDependencyError
from geokit.formats.body import Body

if TYPE_CHECKING:
    from geokit.mesh._model import TriangleMesh

__all__ = ["read_mesh", "write_mesh"]


def read_mesh(path: Path) -> list[Body]:
    """Read each visible Mesh prim of the default or render purpose, and each instance of one, in world space.

    Positions are those of the default time, or of the first sample if there are only samples. Subdivision surfaces are
    read as their control cage.
    """
    _require_usd()
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        reason = " ".join(str(error).split())[:300]
        raise FileFormatError(f"{path}: is not a USD stage ({reason}); the file is damaged, export it again") from None
    transforms = UsdGeom.XformCache(_transform_time(stage))
    bodies = []
    for prim, matrix in _placed(stage.GetPseudoRoot(), transforms, None, path):
        body = _body(UsdGeom.Mesh(prim), matrix)
        if body is not None:
            bodies.append(body)
    if not bodies:
        others = sorted({str(prim.GetTypeName()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)})
        what = f"; it holds {', '.join(others)}" if others else ""
        raise FileFormatError(
            f"{path}: has no visible Mesh prim{what}; convert the geometry to meshes and export again"
        )
    return bodies


def _require_usd() -> None:
    try:
        import pxr  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "reading and writing USD needs the package usd-core; install it with: pip install 'geokit[usd]'"
        ) from None


def _transform_time(stage: Any) -> Any:
    """The default time, or the first sample if a transform has no default, which would count as identity."""
    from pxr import Usd, UsdGeom

    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        xformable = UsdGeom.Xformable(prim)
        if xformable and any(op.GetAttr().Get() is None for op in xformable.GetOrderedXformOps()):
            return Usd.TimeCode.EarliestTime()
    return Usd.TimeCode.Default()


def _placed(root: Any, transforms: Any, base: Any, path: Path) -> Iterator[tuple[Any, Any]]:
    """Mesh prims below ``root`` with their local-to-world matrix; those of point instancers once per instance."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        if imageable and _hidden(imageable):
            prims.PruneChildren()
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            yield from _instances(UsdGeom.PointInstancer(prim), transforms, base, path)
        elif prim.IsA(UsdGeom.Mesh):
            matrix = transforms.GetLocalToWorldTransform(prim)
            yield prim, matrix if base is None else matrix * base


def _hidden(imageable: Any) -> bool:
    from pxr import UsdGeom

    # Proxies and guides represent the same surface a second time.
    if imageable.GetPurposeAttr().Get() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
        return True
    return imageable.GetVisibilityAttr().Get() == UsdGeom.Tokens.invisible


def _instances(instancer: Any, transforms: Any, base: Any, path: Path) -> Iterator[tuple[Any, Any]]:
    from pxr import Usd

    time = Usd.TimeCode.Default()
    if instancer.GetProtoIndicesAttr().Get(time) is None:
        time = Usd.TimeCode.EarliestTime()
    indices = instancer.GetProtoIndicesAttr().Get(time)
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    if not indices or not targets:
        return
    mask = instancer.ComputeMaskAtTime(time)
    # Without the prototype's own transform, which its matrix already contains, and with masked instances left in.
    placements = instancer.ComputeInstanceTransformsAtTime(
        time, time, instancer.ExcludeProtoXform, instancer.IgnoreMask
    )
    world = transforms.GetLocalToWorldTransform(instancer.GetPrim())
    world = world if base is None else world * base
    for row, (index, placement) in enumerate(zip(indices, placements, strict=True)):
        if mask and not mask[row]:
            continue
        if not 0 <= index < len(targets):
            raise FileFormatError(
                f"{path}: point instancer {instancer.GetPath()} uses prototype {index} of {len(targets)}; repair it"
            )
        prototype = instancer.GetPrim().GetStage().GetPrimAtPath(targets[index])
        if not prototype:
            raise FileFormatError(
                f"{path}: point instancer {instancer.GetPath()} has no prototype {targets[index]}; repair it"
            )
        # The prototype keeps its own transform, not those of the prims above it.
        above = transforms.GetLocalToWorldTransform(prototype.GetParent()).GetInverse()
        yield from _placed(prototype, transforms, above * placement * world, path)


def _body(mesh: Any, matrix: Any) -> Body | None:
    from pxr import Usd, UsdGeom

    points = mesh.GetPointsAttr().Get()
    time = Usd.TimeCode.Default()
    if points is None:
        time = Usd.TimeCode.EarliestTime()
        points = mesh.GetPointsAttr().Get(time)
    counts = mesh.GetFaceVertexCountsAttr().Get(time)
    indices = mesh.GetFaceVertexIndicesAttr().Get(time)
    if not points:
        return None
    return Body(
        memoryview(points),
        memoryview(counts or array("i")),
        memoryview(indices or array("i")),
        name=str(mesh.GetPath()),
        # USD multiplies row vectors from the left; geokit's matrices multiply column vectors.
        transform=[[float(matrix[column][row]) for column in range(4)] for row in range(4)],
        clockwise=mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded,
    )


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write one Mesh prim below a default root, through usd-core.

    Raises:
        MissingDependencyError: usd-core is not installed.
    """
    _require_usd()
    import numpy as np
    from pxr import Tf, Usd, UsdGeom, Vt

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
