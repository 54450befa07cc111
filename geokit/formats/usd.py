"""Meshes of USD stages, through usd-core, which reads in a separate process."""

from __future__ import annotations

import glob
import os
import re
import zipfile
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geokit._packages import require_package
from geokit.errors import FileAccessError, FileFormatError, GeokitError
from geokit.formats.file_content.body import Body
from geokit.formats.file_content.references import LONGEST, require_inside
from geokit.formats.scene_content.usd_shapes import SHAPES, is_animated, shape_body, time_of, value_of

if TYPE_CHECKING:
    from geokit.formats.scene_content.usd_materials import Bound, Materials
    from geokit.mesh.model.triangle_mesh import TriangleMesh


def prepare() -> None:
    """Import usd-core and have it look for its plugins and schemas, without starting threads."""
    from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdShade, Work  # noqa: F401

    from geokit.formats.scene_content import usd_materials  # noqa: F401

    Work.SetConcurrencyLimit(1)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.XformCache().GetLocalToWorldTransform(UsdGeom.Mesh.Define(stage, "/mesh").GetPrim())


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read each visible Mesh prim of the default or render purpose, and each instance of one, in world space.

    Cube, Sphere, Cylinder, Cone, Capsule and Plane prims are read as polygons whose vertices lie on them. Other
    geometry is left out, with a note.

    Positions are those of the default time, or of the first sample if there are only samples. Subdivision surfaces are
    read as their control cage. Normals and primvars come along, constant ones on each face. Materials
    (UsdPreviewSurface) have a name, a base color and its texture; ``uv`` are the coordinates that the texture names,
    else the first ones. Where a material has a color, that of the mesh is called ``displayColor``. Layers (sublayers,
    references, payloads and clips) and images are opened from the file's own folder, which needs to be the working
    folder, and from ``folders``.
    """
    UsdGeom = require_package("pxr.UsdGeom")

    from geokit.formats.scene_content.usd_materials import Materials

    stage = open_stage(path, folders)
    transforms = UsdGeom.XformCache(transform_time(stage))
    materials = Materials(path, folders)
    bodies = []
    for prim, matrix in _placed(stage.GetPseudoRoot(), transforms, None, path):
        is_shape = str(prim.GetTypeName()) in SHAPES
        columns = for_columns(matrix)
        body = _shape(prim, columns, materials) if is_shape else _body(UsdGeom.Mesh(prim), columns, materials)
        if body is not None:
            bodies.append(body)
    if bodies:
        notes = (*bodies[0].notes, *_left_out(stage), *materials.notes)
        bodies[0] = bodies[0]._replace(materials=tuple(materials.found), notes=notes, **world_of(stage))
    else:
        others = sorted({str(prim.GetTypeName()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)})
        what = f"; it holds {', '.join(others)}" if others else ""
        if "Mesh" in others:
            raise FileFormatError(
                f"{path}: its Mesh prims have no points, or are hidden{what}; export them with points"
            )
        if "Volume" in others:
            raise FileFormatError(f"{path}: has no visible Mesh prim{what}; load its fields with geokit.volume.load")
        raise FileFormatError(
            f"{path}: has no visible Mesh prim{what}; convert the geometry to meshes and export again"
        )
    return bodies


def _left_out(stage: Any) -> list[str]:
    """Notes on visible geometry that is no mesh, and on what moves."""
    from pxr import UsdGeom

    prims = list(visible(stage.GetPseudoRoot()))
    kinds = {str(prim.GetTypeName()) for prim in prims if prim.IsA(UsdGeom.Gprim)}
    others = sorted(kinds - {"Mesh", "Volume", *SHAPES})
    said = ["its volumes are left out; geokit.volume.load reads them"] if "Volume" in kinds else []
    said += [f"its prims of type {', '.join(others)} are left out"] if others else []
    if any(map(is_animated, prims)):
        said.append("its animations are left out: it is read at the default time, or at the first sample without one")
    return said


def open_stage(path: Path, folders: Sequence[Path]) -> Any:
    """Open a stage, whose layers lie in its own folder or in ``folders``.

    Raises:
        FileAccessError: A layer lies outside, or is a FIFO or a device.
        FileFormatError: It is no stage.
    """
    from pxr import Tf, Usd

    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise FileFormatError(f"{path}: usd-core opens only names in UTF-8; rename the file or its folder") from None
    # They stay open until the stage has them.
    layers = _checked_layers(path, folders)
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        reason = " ".join(str(error).split())[:300]
        raise FileFormatError(f"{path}: is not a USD stage ({reason}); the file is damaged, export it again") from None
    del layers
    return stage


def visible(root: Any, *, within_instancers: bool = True) -> Iterator[Any]:
    """The prims from ``root`` on, of the default or render purpose, that are not hidden, nor below one that is."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        hidden = imageable and _hidden(imageable)
        if hidden or (not within_instancers and prim.IsA(UsdGeom.PointInstancer)):
            prims.PruneChildren()
        if not hidden:
            yield prim


def for_columns(matrix: Any) -> list[list[float]]:
    """A matrix that multiplies column vectors: USD multiplies row vectors from the left."""
    return [[float(matrix[column][row]) for column in range(4)] for row in range(4)]


def world_of(stage: Any) -> dict[str, Any]:
    """``up_axis`` and ``meters_per_unit``, None where the stage does not say."""
    from pxr import UsdGeom

    up = str(UsdGeom.GetStageUpAxis(stage)).lower() if stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis) else None
    # UsdGeom.GetStageMetersPerUnit refuses the floats that some exporters write in place of doubles.
    known = UsdGeom.StageHasAuthoredMetersPerUnit(stage)
    meters = float(stage.GetMetadata(UsdGeom.Tokens.metersPerUnit)) if known else None
    return {"up_axis": up, "meters_per_unit": meters}


def _checked_layers(path: Path, folders: Sequence[Path]) -> list[Any]:
    """Open every layer that the stage will open, after checking where it lies; missing ones are left out.

    Raises:
        FileAccessError: A layer lies outside the folders, or is a FIFO or a device.
    """
    from pxr import Ar, Sdf, Tf

    layers: dict[str, Any] = {}
    waiting = [str(path)]
    while waiting:
        name = waiting.pop()
        if name in layers:
            continue
        try:
            layers[name] = layer = Sdf.Layer.FindOrOpen(name)
        except Tf.ErrorException:
            layers[name] = layer = None
        for reference in _references(layer) if layer else ():
            if reference.startswith("`"):
                raise FileAccessError(
                    f"{path}: refers to {reference[:LONGEST]!r}, an expression, and geokit cannot tell where it leads; "
                    "flatten the stage (usdcat --flatten)"
                )
            found = layer.ComputeAbsolutePath(Sdf.Layer.SplitIdentifier(reference)[0])
            outer = Ar.SplitPackageRelativePathOuter(found)[0] if Ar.IsPackageRelativePath(found) else found
            # The user's search path of USD may find it elsewhere.
            outer = Ar.GetResolver().Resolve(outer).GetPathString() or outer
            for file in [outer, *glob.glob(re.sub("#+", "*", outer))] if "#" in outer else [outer]:
                if os.path.exists(require_inside(reference, path.parent / file, path, folders)):
                    waiting.append(found if file == outer else file)
    return list(layers.values())


def _references(layer: Any) -> list[str]:
    """Every file that composing the layer, or reading its values, opens."""
    found = list(layer.GetCompositionAssetDependencies()) + list(layer.GetExternalAssetDependencies())

    def add_clips(prim: Any) -> None:
        spec = layer.GetPrimAtPath(prim)
        for clips in (spec.GetInfo("clips") or {}).values() if spec and spec.HasInfo("clips") else ():
            if isinstance(clips, dict):
                files = [clips.get("manifestAssetPath"), *clips.get("assetPaths", ())]
                found.extend(file.path for file in files if file)
                found.append(clips.get("templateAssetPath", ""))

    layer.Traverse("/", add_clips)
    return [reference for reference in found if reference]


def transform_time(stage: Any) -> Any:
    """The default time, or the first sample if a transform has no default, which would count as identity."""
    from pxr import Usd, UsdGeom

    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        xformable = UsdGeom.Xformable(prim)
        if xformable and any(op.GetAttr().Get() is None for op in xformable.GetOrderedXformOps()):
            return Usd.TimeCode.EarliestTime()
    return Usd.TimeCode.Default()


def _placed(root: Any, transforms: Any, base: Any, path: Path) -> Iterator[tuple[Any, Any]]:
    """Mesh prims below ``root`` with their local-to-world matrix; those of point instancers once per instance."""
    from pxr import UsdGeom

    for prim in visible(root, within_instancers=False):
        if prim.IsA(UsdGeom.PointInstancer):
            yield from _instances(UsdGeom.PointInstancer(prim), transforms, base, path)
        elif prim.IsA(UsdGeom.Mesh) or str(prim.GetTypeName()) in SHAPES:
            matrix = transforms.GetLocalToWorldTransform(prim)
            yield prim, matrix if base is None else matrix * base


def _hidden(imageable: Any) -> bool:
    from pxr import UsdGeom

    # Proxies and guides represent the same surface a second time.
    if imageable.GetPurposeAttr().Get() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
        return True
    return imageable.GetVisibilityAttr().Get() == UsdGeom.Tokens.invisible


def _instances(instancer: Any, transforms: Any, base: Any, path: Path) -> Iterator[tuple[Any, Any]]:
    time = time_of(
        instancer.GetProtoIndicesAttr(),
        instancer.GetPositionsAttr(),
        instancer.GetOrientationsAttr(),
        instancer.GetScalesAttr(),
    )
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


def _shape(prim: Any, matrix: list[list[float]], materials: Materials) -> Body:
    body = shape_body(prim, matrix)
    bound = materials.of_faces(prim, len(body.counts))
    _, polygon, _, notes = _primvars(prim, (0, len(body.counts), 0), bound)
    return body._replace(polygon_data=polygon, notes=notes)


def _body(mesh: Any, matrix: list[list[float]], materials: Materials) -> Body | None:
    from pxr import UsdGeom

    points = value_of(mesh.GetPointsAttr())
    counts = value_of(mesh.GetFaceVertexCountsAttr())
    indices = value_of(mesh.GetFaceVertexIndicesAttr())
    if not points:
        return None
    counts, indices = memoryview(counts or array("i")), memoryview(indices or array("i"))
    bound = materials.of_faces(mesh.GetPrim(), len(counts))
    sizes = len(points), len(counts), len(indices)
    vertex, polygon, corner, notes = _primvars(mesh.GetPrim(), sizes, bound)
    if any(mesh.GetPrim().HasAttribute(name) for name in ("primvars:skel:jointIndices", "skel:blendShapes")):
        notes += ("its skinned meshes are read as they are stored, without their skeletons and blend shapes",)
    holes = value_of(mesh.GetHoleIndicesAttr())
    if holes:
        counts, indices, polygon, corner = _without_holes(holes, counts, indices, polygon, corner)
    return Body(
        memoryview(points),
        counts,
        indices,
        name=str(mesh.GetPath()),
        transform=matrix,
        clockwise=mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded,
        vertex_data=vertex,
        polygon_data=polygon,
        corner_data=corner,
        notes=notes,
    )


def _without_holes(
    holes: Any, counts: Any, indices: Any, polygon: dict[str, Any], corner: dict[str, Any]
) -> tuple[Any, Any, dict[str, Any], dict[str, Any]]:
    """Polygons without those that the mesh names as holes of its surface, and their data."""
    import numpy as np

    sizes = np.asarray(counts)
    kept = np.ones(len(sizes), bool)
    rows = np.asarray(holes)
    kept[rows[(rows >= 0) & (rows < len(sizes))]] = False
    corners = np.repeat(kept, np.maximum(sizes, 0))
    if len(corners) != len(indices):
        # Damaged, which the caller of the reader reports.
        return counts, indices, polygon, corner
    polygon = {name: np.asarray(values)[kept] for name, values in polygon.items()}
    corner = {name: values[corners] for name, values in corner.items()}
    return sizes[kept], np.asarray(indices)[corners], polygon, corner


def _primvars(
    prim: Any, sizes: tuple[int, int, int], bound: Bound
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], tuple[str, ...]]:
    """Normals, primvars and materials of vertices, polygons and corners, and notes on those that do not fit.

    Args:
        prim: A mesh or a shape.
        sizes: Numbers of vertices, polygons and corners.
        bound: Its materials.
    """
    from pxr import UsdGeom

    vertex_count, polygon_count, corner_count = sizes
    found: tuple[dict[str, Any], dict[str, Any], dict[str, Any]] = {}, {}, {}
    rows = {} if bound.rows is None else {"material": bound.rows}
    notes: list[str] = []
    mesh = UsdGeom.Mesh(prim)
    normals = value_of(mesh.GetNormalsAttr()) if mesh else None
    primvars = UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()
    if not normals and not primvars:
        return {}, rows, {}, ()
    import numpy as np

    from geokit.formats.attributes.columns import from_columns

    def add(name: str, interpolation: str, given: Any) -> None:
        try:
            values = np.array(given)
        except (TypeError, ValueError):
            return
        if values.dtype.kind not in "fiub" or not values.ndim:
            if values.ndim:
                notes.append(f"the array {name!r} of {prim.GetPath()} is left out: it holds no numbers")
            return
        if interpolation == UsdGeom.Tokens.constant and len(values) == 1:
            values, into, count = np.repeat(values, polygon_count, axis=0), found[1], polygon_count
        else:
            into, count = {
                UsdGeom.Tokens.uniform: (found[1], polygon_count),
                UsdGeom.Tokens.faceVarying: (found[2], corner_count),
            }.get(interpolation, (found[0], vertex_count))
        if len(values) == count and count:
            into[name] = values
        # What deforms a mesh is left out with its bones.
        elif not name.startswith("skel:"):
            notes.append(f"the array {name!r} of {prim.GetPath()} is left out: it has {len(values)} rows for {count}")

    if normals:
        add("normal", mesh.GetNormalsInterpolation(), normals)
    pairs = [each for each in primvars if str(each.GetTypeName()).startswith(("texCoord2", "float2", "double2"))]
    mapped = [each for each in pairs if each.GetPrimvarName() == bound.mapped_by]
    mapped += [each for each in pairs if str(each.GetTypeName()).startswith("texCoord2")]
    elements = {str(each.GetPrimvarName()): str(each.GetInterpolation()) for each in primvars}
    for primvar in primvars:
        label = str(primvar.GetPrimvarName())
        # As one name on several elements is written below.
        plain = label.removesuffix(f"_{elements[label]}")
        label = plain if elements.get(plain, elements[label]) != elements[label] else label
        # Colors of geokit's meshes are multiplied with those of materials; these are replaced by them.
        name = label if label == "displayColor" and bound.colored else _NAMES.get(label, label)
        if mapped and label == mapped[0].GetPrimvarName():
            is_uv = primvar == mapped[0] or str(primvar.GetTypeName()).startswith("texCoord2")
            name = "uv" if is_uv else name
        values = primvar.ComputeFlattened(time_of(*filter(None, (primvar.GetAttr(), primvar.GetIndicesAttr()))))
        if values is not None:
            add(name, primvar.GetInterpolation(), values)
    for data in found:
        colors, opacity = data.get("color"), data.get("displayOpacity")
        if colors is not None and opacity is not None and colors.shape[1:] == (3,) and opacity.ndim == 1:
            data["color"] = np.column_stack([colors, data.pop("displayOpacity")])
    vertex, polygon, corner = map(from_columns, found)
    return vertex, {**polygon, **rows}, corner, tuple(notes)


def companions(mesh: TriangleMesh, path: Path) -> dict[str, bytes]:
    """The images of materials beside a file; a .usdz has them inside."""
    from geokit.formats.attributes.mtl import image_files

    return {} if path.suffix.lower() == ".usdz" else image_files(mesh.materials, path.stem)[1]


def companions_of(path: Path) -> set[str]:
    """Names of the images of a file's materials; none if it cannot be read."""
    from geokit.core.content_limit import content_limit
    from geokit.formats.reader import process

    try:
        bodies = process.read_mesh(path, __name__, content_limit(path.stat().st_size, None), [])
    except GeokitError:
        return set()
    return {material.texture_name for body in bodies for material in body.materials}


def holds_texture(data: bytes) -> bool:
    """Whether an image is one of those that each reader of USD knows."""
    return data.startswith((b"\x89PNG", b"\xff\xd8\xff"))


def write_mesh(path: Path, mesh: TriangleMesh, stem: str = "mesh") -> None:
    """Write one Mesh prim below a default root, through usd-core; arrays become primvars, colors of integers floats.

    Materials are bound to the mesh, or to subsets of its faces. Where there are some, ``color`` is a primvar of this
    name, for viewers show ``displayColor`` only without. A .usdz holds all as one layer and the images.

    Args:
        path: The file to write.
        mesh: The mesh.
        stem: The file's final name without its extension, for the names of images.
    Raises:
        MissingDependencyError: usd-core is not installed.
    """
    require_package("pxr")
    import numpy as np
    from pxr import Tf, Usd, UsdGeom, Vt

    from geokit.formats.attributes.columns import utf8
    from geokit.formats.attributes.mtl import image_files

    stage = Usd.Stage.CreateInMemory()
    root = UsdGeom.Xform.Define(stage, "/root")
    stage.SetDefaultPrim(root.GetPrim())
    prim = UsdGeom.Mesh.Define(stage, f"/root/{Tf.MakeValidIdentifier(utf8(mesh.name) or 'mesh')}")
    points = np.ascontiguousarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces).reshape(-1)))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    if len(points):
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    if mesh.up_axis is not None:
        stage.SetMetadata(UsdGeom.Tokens.upAxis, mesh.up_axis.upper())
    if mesh.meters_per_unit is not None:
        UsdGeom.SetStageMetersPerUnit(stage, mesh.meters_per_unit)
    # Without materials it is an array as any other.
    rows = mesh.face_data.get("material") if mesh.materials else None
    tokens = UsdGeom.Tokens
    arrays = [(name, values, tokens.vertex) for name, values in mesh.vertex_data.items()]
    arrays += [(name, values, tokens.uniform) for name, values in mesh.face_data.items() if values is not rows]
    arrays += [
        (name, values.reshape(-1, *values.shape[2:]), tokens.faceVarying) for name, values in mesh.corner_data.items()
    ]
    # Textures have the coordinates of corners before those of vertices; no other array takes the name of these.
    arrays.sort(key=lambda each: (each[0] != "uv", each[0] == "uv" and each[2] != tokens.faceVarying))
    for name, values, interpolation in arrays:
        _write_array(prim, name, values, interpolation, is_tint=rows is not None)
    packed = path.suffix.lower() == ".usdz"
    images, files = image_files(mesh.materials, "image" if packed else stem)
    if rows is not None:
        from geokit.formats.scene_content.usd_materials import write_materials

        write_materials(prim, mesh.materials, rows, images)
    inside = {name: path.parent / f"image_{at}" for at, name in enumerate(files)} if packed else {}
    for name, place in inside.items():
        place.write_bytes(files[name])
    export(stage, path, "mesh.usdc", inside)


def export(stage: Any, path: Path, inner: str, beside: Mapping[str, Path]) -> None:
    """Write a stage in memory to a file; a .usdz holds it as its layer ``inner``, and files ``beside`` it by name.

    Args:
        stage: The stage.
        path: The file.
        inner: Name of the layer in a .usdz.
        beside: Files of the same folder that go into a .usdz, by their names there.

    Raises:
        OSError: It cannot be written.
    """
    from pxr import Sdf, Tf

    # usd-core takes only names in UTF-8, and a folder may have another; as a descriptor it has a plain name.
    folder = os.open(path.parent, os.O_RDONLY) if os.path.isdir("/proc/self/fd") else None
    place = path.parent if folder is None else f"/proc/self/fd/{folder}"
    try:
        name = f"{place}/{path.name}"
        packed = path.suffix.lower() == ".usdz"
        exported = stage.GetRootLayer().Export(f"{name}.usdc" if packed else name)
        if packed:
            archive = Sdf.ZipFileWriter.CreateNew(name)
            exported = bool(archive.AddFile(f"{name}.usdc", inner)) and all(
                bool(archive.AddFile(f"{place}/{file.name}", label)) for label, file in beside.items()
            )
            exported = archive.Save() and exported and _is_whole(path)
    except Tf.ErrorException as error:
        raise OSError(f"usd-core: {getattr(error.args[0], 'commentary', error)}") from None
    finally:
        if folder is not None:
            os.close(folder)
    if not exported:
        raise OSError("usd-core: not all was written")


def _is_whole(path: Path) -> bool:
    """Whether an archive has all its bytes: usd-core does not notice that the last ones find no room."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except zipfile.BadZipFile:
        return False


def _write_array(prim: Any, name: str, values: Any, interpolation: str, *, is_tint: bool) -> None:
    """Write an array as normals, or as one primvar or more; ``is_tint`` says that colors are those beside materials."""
    import numpy as np
    from pxr import Sdf, UsdGeom, Vt

    from geokit.formats.attributes.columns import as_columns
    from geokit.mesh.model.data import full_scale, has_meaning

    primvars, types = UsdGeom.PrimvarsAPI(prim), Sdf.ValueTypeNames

    def add(label: str, kind: Any, array: Any, rows: Any) -> None:
        # One name on vertices, faces and corners is one primvar; the first keeps it.
        free = f"{label}_{interpolation}" if primvars.GetPrimvar(label).HasAuthoredValue() else label
        while primvars.GetPrimvar(free).HasAuthoredValue():
            free += "_"
        primvars.CreatePrimvar(free, kind, interpolation).Set(array.FromNumpy(np.ascontiguousarray(rows)))

    wide = values.dtype == np.float64
    if has_meaning(name, values) and name == "normal" and not prim.GetNormalsAttr().HasAuthoredValue():
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32)))
        prim.SetNormalsInterpolation(interpolation)
    elif has_meaning(name, values) and name == "uv":
        kind = (types.TexCoord2dArray, Vt.Vec2dArray) if wide else (types.TexCoord2fArray, Vt.Vec2fArray)
        add("st", *kind, values if wide else values.astype(np.float32))
    elif has_meaning(name, values) and name == "color":
        colors = (values / full_scale(values.dtype)).astype(np.float32)
        if is_tint:
            kinds = (types.Color3fArray, Vt.Vec3fArray) if colors.shape[1] == 3 else (types.Color4fArray, Vt.Vec4fArray)
            add("color", *kinds, colors)
            return
        add("displayColor", types.Color3fArray, Vt.Vec3fArray, colors[:, :3])
        if colors.shape[1] == 4:
            add("displayOpacity", types.FloatArray, Vt.FloatArray, colors[:, 3])
    else:
        columns = values.shape[1] if values.ndim == 2 else 1
        if name == "displayColor" and values.dtype.kind == "f" and columns == 3:
            add(name, types.Color3fArray, Vt.Vec3fArray, values.astype(np.float32))
            return
        if values.dtype.kind == "f" and columns in (2, 3, 4):
            letter = "d" if wide else "f"
            kind = getattr(types, f"Double{columns}Array" if wide else f"Float{columns}Array")
            add(_primvar_name(name), kind, getattr(Vt, f"Vec{columns}{letter}Array"), values.astype(letter))
            return
        label, dtype = _SCALARS[values.dtype.kind, values.dtype.itemsize]
        kind, array = getattr(types, f"{label}Array"), getattr(Vt, f"{label}Array")
        for part, column in as_columns({name: values}).items():
            add(_primvar_name(part), kind, array, column.astype(dtype))


def _primvar_name(name: str) -> str:
    from pxr import Tf

    return str(Tf.MakeValidIdentifier(name))


# USD's names of attributes with a meaning.
_NAMES = {"displayColor": "color", "normals": "normal"}
# Types of single numbers by kind and bytes, and NumPy's that hold them.
_SCALARS = {
    ("b", 1): ("Bool", "?"),
    ("u", 1): ("UChar", "u1"),
    **{("i", size): ("Int", "i4") for size in (1, 2, 4)},
    ("u", 2): ("Int", "i4"),
    ("u", 4): ("UInt", "u4"),
    ("i", 8): ("Int64", "i8"),
    ("u", 8): ("UInt64", "u8"),
    ("f", 2): ("Float", "f4"),
    ("f", 4): ("Float", "f4"),
    ("f", 8): ("Double", "f8"),
}
