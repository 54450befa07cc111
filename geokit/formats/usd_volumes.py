"""Volumes of USD stages (UsdVol), whose fields lie in .vdb files, through usd-core."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

from geokit._packages import require_package
from geokit.errors import FileAccessError, FileFormatError
from geokit.formats import usd
from geokit.formats.file_content.references import LONGEST, require_inside
from geokit.formats.scene_content.usd_shapes import value_of

VOLUME, FIELDS, ASSET = "Volume", "field:", "OpenVDBAsset"


def prepare() -> None:
    """Import usd-core and its volumes."""
    from pxr import UsdVol  # noqa: F401

    usd.prepare()


def read_grids(path: Path, folders: list[str]) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Find the fields of all visible Volume prims, and read those that lie inside a .usdz.

    Args:
        path: The stage.
        folders: Folders besides the stage's own in which layers and .vdb files may lie.
    Returns:
        ``fields``, each with its ``name``, the ``grid`` in its file ("" for the only one), the ``file``, or "" where it
        is an array, the ``matrix`` from its frame to the world for column vectors, and the ``label`` in messages; the
        types of visible ``shapes``, ``up_axis`` and ``meters_per_unit``, None where the stage does not say, and
        ``notes`` of what was left out. The arrays are files of a .usdz, in the order of the fields that have none.
    Raises:
        FileAccessError: A file lies outside the folders, or is missing.
        FileFormatError: The stage is damaged, or refers to no file.
    """
    UsdGeom = require_package("pxr.UsdGeom")
    allowed = [Path(folder) for folder in folders]
    stage = usd.open_stage(path, allowed)
    transforms = UsdGeom.XformCache(usd.transform_time(stage))
    fields: list[dict[str, Any]] = []
    packed: list[tuple[str, Any]] = []
    shapes, notes = set(), []
    for prim in usd.visible(stage.GetPseudoRoot()):
        if prim.IsA(UsdGeom.Gprim) and prim.GetTypeName() != VOLUME:
            shapes.add(str(prim.GetTypeName()))
        if prim.GetTypeName() != VOLUME:
            continue
        for relation in prim.GetRelationships():
            if not relation.GetName().startswith(FIELDS):
                continue
            name = relation.GetName()[len(FIELDS) :]
            for target in relation.GetForwardedTargets()[:1]:
                asset = stage.GetPrimAtPath(target)
                if not asset or asset.GetTypeName() != ASSET:
                    notes.append(f"field {name} is no {ASSET}, left out")
                    continue
                file, inner = _file(asset, path, allowed)
                grid = value_of(asset.GetAttribute("fieldName"))
                if inner:
                    packed.append((inner, _packed(file, inner)))
                fields.append(
                    {
                        "name": name,
                        "grid": str(grid or ""),
                        "file": "" if inner else str(file),
                        "matrix": usd.for_columns(transforms.GetLocalToWorldTransform(asset)),
                        "label": inner or file.name,
                    }
                )
    return {"fields": fields, "shapes": sorted(shapes), **usd.world_of(stage), "notes": notes}, packed


def _file(asset: Any, path: Path, folders: list[Path]) -> tuple[Path, str]:
    """The file of a field, and its name in it if that is a .usdz."""
    from pxr import Ar

    given = value_of(asset.GetAttribute("filePath"))
    if given is None or not given.path:
        raise FileFormatError(f"{path}: {asset.GetPath()} names no file; set its filePath")
    # What USD does not find has no resolved path.
    found, inner = given.resolvedPath or given.path, ""
    if Ar.IsPackageRelativePath(found):
        found, inner = Ar.SplitPackageRelativePathOuter(found)
    real = require_inside(given.path, path.parent / found, path, folders)
    if not os.path.exists(real):
        raise FileAccessError(f"{path}: refers to {given.path[:LONGEST]!r}, and there is no such file; put it there")
    return real, inner


def _packed(archive: Path, name: str) -> Any:
    """The bytes of a file in a .usdz, which USD stores uncompressed."""
    import numpy as np

    with zipfile.ZipFile(archive) as found:
        try:
            entry = found.getinfo(name)
        except KeyError:
            raise FileAccessError(f"{archive}: holds no {name[:LONGEST]!r}; pack it again") from None
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > archive.stat().st_size:
            raise FileFormatError(
                f"{archive}: {name[:LONGEST]!r} is compressed, which .usdz does not allow; pack it again"
            )
        return np.frombuffer(found.read(entry), np.uint8)


class NewField(NamedTuple):
    """A field to write: its name, which is that of its grid too, USD's names of its type and of its role."""

    name: str
    grid: str
    data_type: str
    role: str


def write_stage(
    path: Path,
    vdb: Path | None,
    asset: str,
    fields: list[NewField],
    extent: Any,
    up_axis: str | None,
    meters_per_unit: float | None,
) -> None:
    """Write one Volume prim below a default root.

    Args:
        path: The target.
        vdb: File of the grids, in the target's folder, that a .usdz takes in; None if it stays where it is.
        asset: Name of the file beside the stage, or in it.
        fields: The fields, with different names.
        extent: Lower and upper corner of all, shape (2, 3); None if they are empty.
        up_axis: The axis that points up; None to leave it unsaid.
        meters_per_unit: Length of the unit [m]; None to leave it unsaid.
    Raises:
        MissingDependencyError: usd-core is not installed.
    """
    require_package("pxr")
    import numpy as np
    from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateInMemory()
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/root").GetPrim())
    volume = UsdVol.Volume.Define(stage, "/root/volume")
    taken: set[str] = set()
    for field in fields:
        label = base = Tf.MakeValidIdentifier(field.name or "grid")
        while label in taken:
            label = f"{base}_{len(taken)}"
        taken.add(label)
        prim = UsdVol.OpenVDBAsset.Define(stage, f"/root/volume/{label}")
        prim.CreateFilePathAttr(Sdf.AssetPath(f"./{asset}"))
        prim.CreateFieldNameAttr(field.grid)
        prim.CreateFieldDataTypeAttr(field.data_type)
        if field.role:
            prim.CreateVectorDataRoleHintAttr(field.role)
        volume.CreateFieldRelationship(label, prim.GetPath())
    if extent is not None:
        volume.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(extent, np.float32)))
    if up_axis is not None:
        stage.SetMetadata(UsdGeom.Tokens.upAxis, up_axis.upper())
    if meters_per_unit is not None:
        UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    usd.export(stage, path, "volume.usdc", {} if vdb is None else {asset: vdb})
