"""Meshes of a USD stage, through usd-core. Runs in the reader process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from geokit.formats.mesh_reader_worker import Refusal, WireBody

__all__ = ["read"]


def read(path: str) -> list[WireBody]:
    """Each visible Mesh prim of the default or render purpose, and each instance of one, in world space.

    Positions are those of the default time, or of the first sample where only samples are there. Subdivision
    surfaces come as their control cage.
    """
    try:
        from pxr import Tf, Usd, UsdGeom
    except ImportError:
        raise ImportError(
            "reading and writing USD needs the package usd-core; install it with: pip install 'geokit[usd]'"
        ) from None
    try:
        stage = Usd.Stage.Open(path)
    except Tf.ErrorException as error:
        reason = " ".join(str(error).split())[:300]
        raise Refusal(f"is not a USD stage ({reason}); the file is damaged, export it again") from None
    transforms = UsdGeom.XformCache(_transform_time(stage))
    bodies = []
    for prim, matrix in _placed(stage.GetPseudoRoot(), transforms, None):
        body = _body(UsdGeom.Mesh(prim), matrix)
        if body is not None:
            bodies.append(body)
    if not bodies:
        others = sorted({str(prim.GetTypeName()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)})
        what = f"; it holds {', '.join(others)}" if others else ""
        raise Refusal(f"has no visible Mesh prim{what}; convert the geometry to meshes and export again")
    return bodies


def _transform_time(stage: Any) -> Any:
    """The default time, or the first sample where a transform has no default: it would count as identity."""
    from pxr import Usd, UsdGeom

    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        xformable = UsdGeom.Xformable(prim)
        if xformable and any(op.GetAttr().Get() is None for op in xformable.GetOrderedXformOps()):
            return Usd.TimeCode.EarliestTime()
    return Usd.TimeCode.Default()


def _placed(root: Any, transforms: Any, base: Any) -> Iterator[tuple[Any, Any]]:
    """Mesh prims below ``root`` with their local-to-world matrix, those of point instancers once per instance."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        if imageable and _hidden(imageable):
            prims.PruneChildren()
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            yield from _instances(UsdGeom.PointInstancer(prim), transforms, base)
        elif prim.IsA(UsdGeom.Mesh):
            matrix = transforms.GetLocalToWorldTransform(prim)
            yield prim, matrix if base is None else matrix * base


def _hidden(imageable: Any) -> bool:
    from pxr import UsdGeom

    # Proxies and guides stand for the same surface a second time.
    if imageable.GetPurposeAttr().Get() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
        return True
    return imageable.GetVisibilityAttr().Get() == UsdGeom.Tokens.invisible


def _instances(instancer: Any, transforms: Any, base: Any) -> Iterator[tuple[Any, Any]]:
    from pxr import Usd

    time = Usd.TimeCode.Default()
    if instancer.GetProtoIndicesAttr().Get(time) is None:
        time = Usd.TimeCode.EarliestTime()
    indices = instancer.GetProtoIndicesAttr().Get(time)
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    if not indices or not targets:
        return
    mask = instancer.ComputeMaskAtTime(time)
    # Without the prototype's own transform, which is in its matrix already, and with masked instances in place.
    placements = instancer.ComputeInstanceTransformsAtTime(
        time, time, instancer.ExcludeProtoXform, instancer.IgnoreMask
    )
    world = transforms.GetLocalToWorldTransform(instancer.GetPrim())
    world = world if base is None else world * base
    for row, (index, placement) in enumerate(zip(indices, placements, strict=True)):
        if mask and not mask[row]:
            continue
        if not 0 <= index < len(targets):
            raise Refusal(f"point instancer {instancer.GetPath()} uses prototype {index} of {len(targets)}; repair it")
        prototype = instancer.GetPrim().GetStage().GetPrimAtPath(targets[index])
        if not prototype:
            raise Refusal(f"point instancer {instancer.GetPath()} has no prototype {targets[index]}; repair it")
        # The prototype keeps its own transform, not those of the prims above it.
        above = transforms.GetLocalToWorldTransform(prototype.GetParent()).GetInverse()
        yield from _placed(prototype, transforms, above * placement * world)


def _body(mesh: Any, matrix: Any) -> WireBody | None:
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
    return WireBody(
        name=str(mesh.GetPath()),
        arrays=(("<f4", _bytes(points)), ("<i4", _bytes(counts)), ("<i4", _bytes(indices))),
        # USD multiplies row vectors from the left; geokit's matrices multiply column vectors.
        transform=[float(matrix[column][row]) for row in range(4) for column in range(4)],
        clockwise=mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded,
    )


def _bytes(values: Any) -> bytes:
    return memoryview(values).tobytes() if values else b""
