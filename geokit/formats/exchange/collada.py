"""Scenes of COLLADA (.dae), through pycollada, which reads in a separate process."""

from __future__ import annotations

import io
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package
from geokit.core.files import damaged
from geokit.errors import FileFormatError
from geokit.formats.attributes.mtl import image_content
from geokit.formats.file_content.body import Body, FileMaterial

# Elements without which the geometry is whole.
_VIEWS = ("library_animations", "library_animation_clips", "library_cameras", "library_lights", "instance_camera",
          "instance_light")  # fmt: skip
_MOVING = "its animations are left out: it is read as it stands without them"
_LOOKS = ("library_effects", "library_images", "library_materials", "bind_material")


def prepare() -> None:
    """Import pycollada."""
    require_package("collada")


def read_mesh(path: Path, folders: Sequence[Path]) -> list[Body]:
    """Read each geometry at each of its places in the scene; nothing is merged.

    Polygons stay polygons, and positions have the file's digits. Normals, texture coordinates and colors belong to
    corners; materials have a name, a diffuse color and its texture. Skinned and morphed geometries are read in their
    bind shape. Axes are not turned. Images are read from the file's own folder and from ``folders``.

    Raises:
        FileFormatError: The file is damaged, or holds no polygons.
    """
    require_package("collada")
    notes: list[str] = []
    # NumPy says so where text is no number, and pycollada goes on with what came before.
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        document = _opened(path, notes)
    # The element of a channel, not the library: this may be empty.
    if document.xmlnode.find(f".//{document.tag('channel')}") is not None:
        notes.append(_MOVING)
    for error in map(str, document.errors):
        if error.endswith("}skew"):
            raise FileFormatError(f"{path}: has a node that is skewed, which is not read; export it with matrices")
        if "geometry" in error or "scene node" in error:
            notes.append(f"left out: {error}")
    materials: dict[str, int] = {}
    listed: list[FileMaterial] = []

    def number(symbol: str | None, nodes: dict[str, Any]) -> int:
        found = getattr(nodes.get(symbol or ""), "target", None) or document.materials.get(symbol or "")
        if found is None:
            return -1
        if found.id not in materials:
            materials[found.id] = len(listed)
            listed.append(_material(found, path, folders, notes))
        return materials[found.id]

    bodies: list[Body] = []
    for geometry, matrix, nodes in _placed(document, notes):
        # Primitives of one geometry share their vertices, so that what they have in common stays connected.
        groups: dict[int, list[Any]] = {}
        for primitive in geometry.primitives:
            if type(primitive).__name__ == "LineSet":
                notes.append("lines are left out")
            elif primitive.xmlnode.find(document.tag("ph")) is not None:
                raise FileFormatError(f"{path}: has polygons with holes, which are not read; export it triangulated")
            elif len(primitive):
                groups.setdefault(id(primitive.sources["VERTEX"][0][4]), []).append(primitive)
        for primitives in groups.values():
            rows = [number(one.material, nodes) for one in primitives]
            bodies.append(_body(geometry, primitives, matrix, rows, path))
    if not bodies:
        raise FileFormatError(f"{path}: holds no polygons; a mesh needs faces, export the surface itself")
    unit = document.assetInfo.unitmeter if document.xmlnode.find(f".//{document.tag('unit')}") is not None else None
    up = document.xmlnode.findtext(f"{document.tag('asset')}/{document.tag('up_axis')}", "").strip()
    axis = up[0].lower() if up in ("X_UP", "Y_UP", "Z_UP") else None
    bodies[0] = bodies[0]._replace(
        materials=tuple(listed), notes=tuple(notes), meters_per_unit=unit, up_axis=axis
    )  # fmt: skip
    return bodies


def _opened(path: Path, notes: list[str]) -> Any:
    """The document; where it is damaged, without what its geometry does not need."""
    from collada import Collada
    from collada.common import DaeError, DaeUnsupportedError

    try:
        return Collada(str(path), ignore=[DaeUnsupportedError])
    except DaeError as error:
        reason = error.msg
    tree = ElementTree.parse(path).getroot()
    for left_out in (_VIEWS, _LOOKS):
        note = f"materials are left out: {reason}" if left_out == _LOOKS else ""
        for parent in list(tree.iter()):
            for child in list(parent):
                if child.tag.rpartition("}")[2] in left_out:
                    if child.find(".//{*}channel") is not None:
                        notes.append(_MOVING)
                    parent.remove(child)
        try:
            document = Collada(io.BytesIO(ElementTree.tostring(tree, "utf-8")), ignore=[DaeUnsupportedError])
        except DaeError as error:
            reason = error.msg
        else:
            notes += [note] if note else []
            return document
    raise FileFormatError(f"{path}: cannot be read ({reason}); the file is damaged, export it again")


def _placed(document: Any, notes: list[str]) -> Iterator[tuple[Any, NDArray[np.float64] | None, dict[str, Any]]]:
    """Each geometry of the scene, its matrix to the world, and its materials by symbol."""
    if document.scene is None:
        for geometry in document.geometries:
            yield geometry, None, {}
        return
    for bound in document.scene.objects("geometry"):
        yield bound.original, np.asarray(bound.matrix, np.float64), bound.materialnodebysymbol
    for bound in document.scene.objects("controller"):
        notes.append("skinned and morphed parts are read in their bind shape")
        skin = getattr(bound, "skin", None)
        matrix = np.asarray(bound.matrix, np.float64)
        if skin is not None:
            matrix = matrix @ np.asarray(skin.bind_shape_matrix, np.float64)
        shape = skin.geometry if skin is not None else bound.original.source_geometry
        yield shape, matrix, bound.materialnodebysymbol


def _body(
    geometry: Any, primitives: list[Any], matrix: NDArray[np.float64] | None, materials: list[int], path: Path
) -> Body:
    points = _numbers(primitives[0].sources["VERTEX"][0][4], path)
    indices, counts = [], []
    for primitive in primitives:
        indices.append(np.asarray(primitive.vertex_index).ravel())
        # How many corners each polygon has.
        corners = primitive.vcounts if hasattr(primitive, "vcounts") else np.full(len(primitive), 3)
        counts.append(np.asarray(corners, np.int64))
        if counts[-1].sum() != len(indices[-1]):
            raise damaged(path, f"declares {counts[-1].sum()} corners and holds {len(indices[-1])}")
    used = np.concatenate(counts)
    polygon = {"material": np.repeat(np.array(materials, np.int32), [len(part) for part in counts])}
    return Body(
        points[:, :3],
        used,
        np.concatenate(indices).astype(np.int64),
        name=geometry.name or geometry.id or "",
        transform=None if matrix is None or np.array_equal(matrix, np.eye(4)) else matrix,
        polygon_data=polygon if max(materials) >= 0 else {},
        corner_data=_corners(primitives),
    )


def _corners(primitives: list[Any]) -> dict[str, NDArray[np.float64]]:
    """The attributes that all primitives have, a row for each corner."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, semantic, widths in (("normal", "NORMAL", (3,)), ("uv", "TEXCOORD", (2,)), ("color", "COLOR", (3, 4))):
        parts = []
        for primitive in primitives:
            inputs = primitive.sources.get(semantic, ())
            if inputs:
                offset, source = inputs[0][0], inputs[0][4]
                rows = primitive.index.reshape(-1, primitive.index.shape[-1])[:, offset]
                values = np.asarray(source.data, np.float64)
                if values.ndim == 2 and values.shape[1] in widths and rows.max() < len(values):
                    parts.append(values[rows])
        if len(parts) == len(primitives) and len({part.shape[1] for part in parts}) == 1:
            found[name] = np.concatenate(parts)
    return found


def _numbers(source: Any, path: Path) -> NDArray[np.float64]:
    """Positions with the digits of the file, of which pycollada keeps those of float32."""
    array = next(node for node in source.xmlnode.iter() if str(node.tag).endswith("}float_array"))
    numbers = np.array((array.text or "").split(), np.float64)
    declared = array.get("count")
    if (declared is not None and declared.strip() != str(len(numbers))) or len(numbers) != source.data.size:
        raise damaged(path, f"declares {declared} coordinates and holds {len(numbers)}")
    return numbers.reshape(source.data.shape)


def _material(material: Any, path: Path, folders: Sequence[Path], notes: list[str]) -> FileMaterial:
    """A material with its diffuse color or texture; a note if the texture is not read."""
    diffuse = getattr(material.effect, "diffuse", None)
    name = material.name or material.id or ""
    image = getattr(getattr(getattr(diffuse, "sampler", None), "surface", None), "image", None)
    if image is not None:
        reference = unquote(urlsplit(image.path).path) if image.path.startswith("file:") else unquote(image.path)
        content = image_content(reference, path, folders, notes)
        return FileMaterial(name, None, Path(reference.replace("\\", "/")).name, content)
    # Its fourth number says nothing: transparency is written elsewhere, in several ways.
    color = (*map(float, diffuse[:3]), 1.0) if isinstance(diffuse, tuple) and len(diffuse) >= 3 else None
    return FileMaterial(name, color)
