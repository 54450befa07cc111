"""Materials of USD prims: names, base colors and their textures. It is imported where there may be some."""

from __future__ import annotations

import zipfile
import zlib
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from geokit.errors import FileAccessError
from geokit.formats.attributes.gltf import has_alpha
from geokit.formats.attributes.mtl import LARGEST_FILE, image_content
from geokit.formats.file_content.body import FileMaterial
from geokit.formats.file_content.references import LONGEST, require_inside

if TYPE_CHECKING:
    from geokit.mesh.model.data import Material

_OTHER_TEXTURES = "of its textures only those of the base color are read"


class Bound(NamedTuple):
    """Materials of the polygons of a prim.

    Args:
        rows: The row of each polygon in the list of materials, or -1; None if none has a material.
        mapped_by: The primvar whose coordinates the first texture has; "" if no material says.
        colored: Whether a material has a color or a texture, which then count in place of ``displayColor``.
    """

    rows: array[int] | None = None
    mapped_by: str = ""
    colored: bool = False


class Materials:
    """Collects the materials of a stage as its prims name them.

    Attributes:
        found: The materials, in the order in which they were met.
        notes: What of them is left out.
    """

    def __init__(self, path: Path, folders: Sequence[Path]) -> None:
        self.found: list[FileMaterial] = []
        self.notes: list[str] = []
        self._path, self._folders = path, folders
        self._rows: dict[str, int] = {}
        self._images: dict[str, tuple[str, bytes]] = {}
        self._coordinates: list[str] = []

    def of_faces(self, prim: Any, count: int) -> Bound:
        """The materials of a prim's polygons.

        Args:
            prim: A mesh or a shape.
            count: Number of its polygons.
        """
        from pxr import UsdShade

        rows = array("i", [self._row(prim)]) * count
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            row = self._row(subset.GetPrim())
            for face in subset.GetIndicesAttr().Get() or ():
                if 0 <= face < count:
                    rows[face] = row
        used = sorted(set(rows) - {-1})
        colored = any(self.found[row].color is not None or self.found[row].texture for row in used)
        return Bound(rows if used else None, next(filter(None, (self._coordinates[row] for row in used)), ""), colored)

    def _row(self, prim: Any) -> int:
        from pxr import UsdShade

        bindings = UsdShade.MaterialBindingAPI(prim)
        # Both purposes include those of any.
        purposes = (UsdShade.Tokens.preview, UsdShade.Tokens.full)
        material = next(filter(None, (bindings.ComputeBoundMaterial(purpose)[0] for purpose in purposes)), None)
        if material is None:
            return -1
        prim = material.GetPrim()
        # Each instance has its own path to a material inside.
        path = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if path not in self._rows:
            self._rows[path] = len(self.found)
            try:
                read, mapped_by = self._read(material)
            except (TypeError, ValueError, RuntimeError) as error:  # values of other types than the names promise
                read, mapped_by = FileMaterial(_name(prim)), ""
                self.notes.append(f"the look of material {prim.GetName()!r} is left out ({type(error).__name__})")
            self.found.append(read)
            self._coordinates.append(mapped_by)
        return self._rows[path]

    def _read(self, material: Any) -> tuple[FileMaterial, str]:
        name = _name(material.GetPrim())
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            self.notes.append("of materials other than UsdPreviewSurface only the names are read")
            return FileMaterial(name), ""
        color, opacity, threshold = None, 1.0, 0.0
        texture = opaque_by = None
        for given in shader.GetInputs():
            label = str(given.GetBaseName())
            source = next((one for one in _shaders(given) if one.GetIdAttr().Get() == "UsdUVTexture"), None)
            value = None if source else _value(given)
            if label == "diffuseColor":
                texture = source
                if source is None and value is None and given.HasConnectedSource():
                    if not _is_primvar(given, "displayColor"):
                        self.notes.append(f"the color of material {name!r} is computed, which is not read")
                elif value is not None:
                    color = tuple(map(float, value))
            elif label == "opacity":
                opaque_by = source
                opacity = opacity if value is None else float(value)
            elif label == "opacityThreshold":
                threshold = threshold if value is None else float(value)
            elif source is not None:
                self.notes.append(_OTHER_TEXTURES)
        image_name, content, mapped_by = "", b"", ""
        if texture is not None:
            image_name, content = self._image(texture)
            color, mapped_by = self._scale(texture, name), self._mapped_by(texture, name)
        if opacity < 1.0:
            color = (*(color or (1.0, 1.0, 1.0))[:3], opacity)
        elif color is not None:
            color = (*color[:3], 1.0)
        if opaque_by is not None and (texture is None or opaque_by.GetPrim() != texture.GetPrim()):
            self.notes.append(_OTHER_TEXTURES)
            opaque_by = None
        cutoff = None
        if has_alpha(color, content):
            # The alpha of an image counts only where the opacity is taken from it.
            cutoff = threshold if threshold > 0.0 else None if opacity < 1.0 or opaque_by else 0.0
        return FileMaterial(name, color, image_name, content, cutoff), mapped_by

    def _scale(self, texture: Any, name: str) -> tuple[float, ...] | None:
        """What the colors of a texture are multiplied by; None if the file does not say."""
        values = {str(given.GetBaseName()): _value(given) for given in texture.GetInputs()}
        if any(values.get("bias") or ()):
            self.notes.append(f"what is added to the texture of material {name!r} is left out")
        scale = values.get("scale")
        return None if scale is None else tuple(map(float, scale))

    def _mapped_by(self, texture: Any, name: str) -> str:
        """The primvar whose coordinates a texture has; "" if the file does not say."""
        given = texture.GetInput("st")
        shader = next(_shaders(given), None) if given else None
        if shader is not None and shader.GetIdAttr().Get() == "UsdTransform2d":
            neutral = {"scale": (1.0, 1.0), "rotation": 0.0, "translation": (0.0, 0.0)}
            for label, plain in neutral.items():
                value = _value(shader.GetInput(label)) if shader.GetInput(label) else None
                if value is not None and value != plain:
                    self.notes.append(f"the transform of the texture of material {name!r} is left out")
            given = shader.GetInput("in")
            shader = next(_shaders(given), None) if given else None
        wanted = shader.GetInput("varname") if shader is not None else None
        return str(_value(wanted) or "") if wanted else ""

    def _image(self, texture: Any) -> tuple[str, bytes]:
        """Name and bytes of the image of a texture; no bytes and a note where it is not read."""
        from pxr import Ar

        given = texture.GetInput("file")
        asset = _value(given) if given else None
        reference = str(getattr(asset, "path", "") or "")
        where = str(getattr(asset, "resolvedPath", "") or "") or reference
        if where in self._images:
            return self._images[where]
        plain = reference.replace("\\", "/").rpartition("/")[2].rstrip("]").rpartition("[")[2]
        content = b""
        if not reference:
            self.notes.append("a texture without a file is left out")
        elif "<UDIM>" in reference:
            self.notes.append(f"the texture {reference[:LONGEST]!r} is left out: it is of several images")
        elif Ar.IsPackageRelativePath(where):
            outer, inner = Ar.SplitPackageRelativePathOuter(where)
            try:
                archive = require_inside(reference, self._path.parent / outer, self._path, self._folders)
                with zipfile.ZipFile(archive) as held:
                    if held.getinfo(inner).file_size > LARGEST_FILE:
                        self.notes.append(f"{reference[:LONGEST]!r} is too large: its texture is left out")
                    else:
                        content = held.read(inner)
            except FileAccessError as error:
                self.notes.append(f"{str(error).removeprefix(f'{self._path}: ')} (its texture is left out)")
            except (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
                self.notes.append(f"{reference[:LONGEST]!r} cannot be unpacked ({error}): its texture is left out")
        else:
            content = image_content(where, self._path, self._folders, self.notes)
        self._images[where] = plain, content
        return plain, content


def _name(prim: Any) -> str:
    return str(prim.GetDisplayName() or prim.GetName())


def _shaders(given: Any) -> Iterator[Any]:
    """The shaders whose outputs an input has, through the inputs of materials and of groups of nodes."""
    from pxr import UsdShade

    for attribute in UsdShade.Utils.GetValueProducingAttributes(given):
        shader = UsdShade.Shader(attribute.GetPrim())
        if shader and UsdShade.Output.IsOutput(attribute):
            yield shader


def _is_primvar(given: Any, name: str) -> bool:
    """Whether an input is the array of a name on the mesh, which comes along anyway."""
    shader = next(_shaders(given), None)
    wanted = shader.GetInput("varname") if shader is not None else None
    return bool(wanted) and str(_value(wanted) or "") == name


def _value(given: Any) -> Any:
    """The value of an input, at the first sample where there is no default; None if a shader gives it."""
    from pxr import Usd, UsdShade

    for attribute in UsdShade.Utils.GetValueProducingAttributes(given):
        if not UsdShade.Output.IsOutput(attribute):
            value = attribute.Get()
            return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value
    return None


def write_materials(mesh: Any, materials: Sequence[Material], rows: Any, images: Sequence[str]) -> None:
    """Write materials as UsdPreviewSurface, and bind them to a mesh or to subsets of its faces.

    Args:
        mesh: The prim.
        materials: The materials.
        rows: That of each face, or -1.
        images: The file of each one's texture, "" for none.
    """
    from pxr import Sdf, Tf, UsdGeom, UsdShade, Vt

    stage, types = mesh.GetPrim().GetStage(), Sdf.ValueTypeNames
    used = np.unique(rows).tolist()
    mapped = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").HasAuthoredValue()
    for row, (given, image) in enumerate(zip(materials, images, strict=True)):
        if row not in used:
            continue
        # Names may be equal, and those of prims are letters and digits.
        place = f"{mesh.GetPath()}_materials/{Tf.MakeValidIdentifier(given.name or 'material')}_{row}"
        material = UsdShade.Material.Define(stage, place)
        material.GetPrim().SetDisplayName(given.name or "material")
        surface = UsdShade.Shader.Define(stage, f"{place}/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        clear = given.alpha_cutoff != 0.0
        if given.alpha_cutoff:
            surface.CreateInput("opacityThreshold", types.Float).Set(float(given.alpha_cutoff))
        if image:
            texture = UsdShade.Shader.Define(stage, f"{place}/image")
            texture.CreateIdAttr("UsdUVTexture")
            texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{image}"))
            for side in ("wrapS", "wrapT"):
                texture.CreateInput(side, types.Token).Set("repeat")
            if given.color is not None:
                texture.CreateInput("scale", types.Float4).Set(tuple(map(float, given.color)))
            if mapped:
                reader = UsdShade.Shader.Define(stage, f"{place}/reader")
                reader.CreateIdAttr("UsdPrimvarReader_float2")
                reader.CreateInput("varname", types.String).Set("st")
                reader.CreateOutput("result", types.Float2)
                texture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
            outputs = {"diffuseColor": "rgb"}
            if clear and given.texture is not None and has_alpha(given.color, given.texture.data):
                outputs["opacity"] = "a"
            for label, channels in outputs.items():
                kind = types.Color3f if channels == "rgb" else types.Float
                texture.CreateOutput(channels, types.Float3 if channels == "rgb" else types.Float)
                surface.CreateInput(label, kind).ConnectToSource(texture.ConnectableAPI(), channels)
        elif given.color is not None:
            surface.CreateInput("diffuseColor", types.Color3f).Set(tuple(map(float, given.color[:3])))
            if clear and given.color[3] != 1.0:
                surface.CreateInput("opacity", types.Float).Set(float(given.color[3]))
        bound = mesh.GetPrim()
        if len(used) > 1:
            faces = Vt.IntArray.FromNumpy(np.flatnonzero(rows == row).astype(np.int32))
            family = UsdShade.Tokens.materialBind
            bound = UsdGeom.Subset.CreateGeomSubset(mesh, f"material_{row}", "face", faces, family).GetPrim()
            UsdGeom.Subset.SetFamilyType(mesh, family, UsdGeom.Tokens.nonOverlapping)
        UsdShade.MaterialBindingAPI.Apply(bound).Bind(material)
